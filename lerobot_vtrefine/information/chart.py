"""A study as one picture: errors per quantity, and the expert's success."""

from pathlib import Path

from lerobot_vtrefine.information.quantities import PARTS, unit_of
from lerobot_vtrefine.information.study import TRUTH, Study

SHOWN = tuple(f"{part}_{axis}" for part in PARTS for axis in ("x", "y", "z", "rx", "ry", "rz"))


def draw(found: Study, path: Path) -> None:
    """Three rows of errors (part in hand, plug in socket) and one of success."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(len(PARTS) + 1, 1, figsize=(10, 13), constrained_layout=True)
    for axis, part in zip(axes, PARTS, strict=False):
        names = [name for name in SHOWN if name.startswith(part)]
        count = len(found.findings)
        for index, finding in enumerate(found.findings):
            places = [place + 0.8 * index / count for place in range(len(names))]
            share = [finding.rms[name][0] / found.prior[name] for name in names]
            axis.bar(places, share, 0.8 / count, align="edge", label=f"{finding.senses}, {finding.history}")
        labels = [f"{name.rsplit('_', 1)[1]}\n{found.prior[name]:.2f} {unit_of(name)[1]}" for name in names]
        axis.set_xticks([place + 0.4 for place in range(len(names))], labels)
        axis.set_ylim(0, 1.1)
        axis.set_ylabel("error / prior")
        axis.set_title(part.replace("_", " "))
    axes[0].legend(fontsize=8, ncols=2, title="senses, frames of history")
    shown = [(TRUTH, found.success_of(TRUTH))]
    shown += [(s, found.success_of(s)) for s in dict.fromkeys(f.senses for f in found.findings)]
    measured = [(name, rate) for name, rate in shown if rate is not None]
    axes[-1].bar([name for name, _ in measured], [rate for _, rate in measured])
    axes[-1].set_ylim(0, 1)
    axes[-1].set_title("success of the expert that acts on estimates")
    figure.savefig(path, dpi=90)
    plt.close(figure)
