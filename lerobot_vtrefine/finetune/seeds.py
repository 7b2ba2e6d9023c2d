"""Which environment seeds a fine-tuning run uses; an episode is a function of its seed."""

TRAINING_SEEDS = 1_000_000
"""Training episode i of a run, counted over iterations and ranks, has seed TRAINING_SEEDS + seed + i.

Runs share no episode when their seeds differ by more than their episodes (the demo's differ by 10 000 000).
Smaller seeds, and those past the last episode, are free for demonstrations and evaluation.
"""

EVALUATION_SEEDS = 500_000
"""First seed of the evaluations during training (``lerobot-eval`` counts up from its own --seed)."""
