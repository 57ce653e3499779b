"""Free runs and equation errors of a fitted model: the figures that users know, before and after."""
