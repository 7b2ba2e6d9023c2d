"""Console entry points: thin wrappers that parse options and call the library."""
