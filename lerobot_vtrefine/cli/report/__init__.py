"""Results of a pipeline as ``results.json`` and as one self-contained page."""
