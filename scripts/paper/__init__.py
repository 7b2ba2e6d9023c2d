"""The paper's tables in simulation, for scripts/compare_paper.py."""
