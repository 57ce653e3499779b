"""What is registered, as a reader is shown it, and plants that are files.

``listing`` describes parts, ``files`` makes plants of FMUs, couplings and structures.
"""
