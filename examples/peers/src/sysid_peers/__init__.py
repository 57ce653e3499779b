"""Identifiers of other packages behind the interface of sysid-harness, one module for each kind of model."""
