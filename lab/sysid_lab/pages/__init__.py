"""What a reader sees of a study: headline, tables, the confusion matrix, bounds of rates.

May import the rows of a study and the truths; only what writes pages imports it.
"""
