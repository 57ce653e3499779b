"""FMUs (FMI 2 and 3, co-simulation and model exchange) behind the stepping interface; fmpy reads and loads them.

``plant`` has the plant, ``as_is`` runs a file by its own experiment, ``probe`` tries one before it is scored,
``engine`` steps through the function pointers. Our own mockups lie in ``plants/mockups``.
"""
