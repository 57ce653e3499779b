"""What a name or a file on the command line means: registered parts, plants that are files, files of any kind.

``listing`` describes parts, ``files`` makes plants of FMUs, couplings and structures, ``as_is`` runs them with their
own experiment, ``contents`` says what is inside a file, ``stored`` reads models that were fitted before.
"""
