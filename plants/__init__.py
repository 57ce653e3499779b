"""Plants: engines and data behind the one stepping interface of :mod:`harness.protocols`."""
