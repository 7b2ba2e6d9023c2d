"""A chain of commands that can be interrupted and continued."""
