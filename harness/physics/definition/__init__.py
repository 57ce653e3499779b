"""What a model consists of: parameters, ports, dimensions, and the equations that everything is derived from.

Imports no other room of physics. Add a kind of port here.
"""
