"""What a model is, written once: mechanisms and ODEs in symbols, parameters, ports; everything else is derived.

Imports no other room of physics. Add a kind of port here.
"""
