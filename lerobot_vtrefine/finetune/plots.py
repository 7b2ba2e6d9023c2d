"""Learning curves of a fine-tuning run."""

from pathlib import Path

from lerobot_vtrefine.whole_files import whole_file

PANELS: tuple[tuple[str, dict[str, str]], ...] = (
    ("success", {"success": "training (noisy sampler)", "eval_success": "held-out seeds (deployed sampler)"}),
    ("return", {"return": "training", "eval_return": "held-out seeds"}),
    ("approximate KL", {"approx_kl": "approximate KL"}),
    ("clip fraction", {"clip_fraction": "clip fraction"}),
    ("explained variance", {"explained_variance": "critic"}),
    ("environment steps per second", {"steps_per_s": "rollout and update"}),
)


def draw_curves(rows: list[dict[str, float]], path: Path) -> None:
    """Draw metrics over iterations to a PNG; rows may lack some (evaluations are rarer than iterations)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6))
    figure.subplots_adjust(0.06, 0.09, 0.985, 0.94, 0.2, 0.42)  # "constrained" takes longer than all the rest
    FigureCanvasAgg(figure)
    for axes, (title, series) in zip(figure.subplots(2, 3).flat, PANELS, strict=True):
        for key, label in series.items():
            points = [(row["iteration"], row[key]) for row in rows if key in row]
            if points:
                axes.plot(
                    *zip(*points, strict=True), label=label, marker="o" if key.startswith("eval") else None
                )
        axes.set_title(title)
        axes.set_xlabel("iteration")
        axes.grid(alpha=0.3)
        if len(series) > 1 and axes.has_data():
            axes.legend(fontsize=8)
        if title == "success":
            axes.set_ylim(-0.02, 1.02)
    with whole_file(path) as part:
        figure.savefig(part, dpi=110, format="png")
