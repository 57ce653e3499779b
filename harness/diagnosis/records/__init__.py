"""The data before they are judged: checked, thinned, cut; what their columns and motions tell."""
