"""Pictures of the documentation, for scripts/make_figures.py."""
