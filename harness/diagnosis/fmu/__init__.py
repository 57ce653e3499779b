"""The likelihood where the nominal model is an FMU: free runs, compared as those of any process."""
