"""The likelihood as a form of the search, and what only that form needs."""
