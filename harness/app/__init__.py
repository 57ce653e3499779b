"""``sysid open``: a page on loopback for a person who would rather look; it runs ``sysid`` commands and nothing else.

``gate`` lets in only the browser that was sent here, ``reach`` says which files may be touched, ``logs`` reads them and
thins them for a plot, ``commands`` turns what was chosen into the words of a command line, ``jobs`` runs these words in
child processes, ``server`` puts it on a socket, ``static`` is what the browser shows. Imports the front door
(:mod:`harness.api`), Starlette and uvicorn (extra ``app``).
"""
