"""Files of recorded data behind one face: text, Excel, binary tables, measurement logs, tables in memory.

Imports no other room of data. Add a format as a file with the face of ``table``.
"""
