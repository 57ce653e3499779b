"""Identifiers: one file for each family, each found through an entry point."""
