"""The comparison's results in words."""

from typing import Any

from runs.comparison import effect, interval_text, rate_text


def as_text(results: dict[str, Any]) -> str:
    """The comparison as a Markdown table, and a sentence per reality."""
    lines = [
        "| stand-in reality | trained in | success in reality | in its own simulator |",
        "|---|---|---|---|",
    ]
    words = []
    for name, row in results.items():
        for world in ("plain", "diagnosed"):
            real, own = (rate_text(row[f"{world} in {where}"]) for where in ("reality", "its own simulator"))
            lines.append(f"| {name} | the {world} simulator | {real} | {own} |")
        words.append(sentence(name, row))
    return "\n".join([*lines, "", *words])


def sentence(name: str, row: dict[str, Any]) -> str:
    """What the hidden physics costs a policy that does not know it, and what diagnosis brings back."""
    gap, gain = row["reality_minus_simulator"], row["diagnosed_minus_plain"]
    found = ", ".join(row["verdict"]["causes"]) or "nothing"
    return (
        f"{name}: the plain simulator's policy changes by {interval_text(**gap)} in the"
        f" stand-in reality; training in the diagnosed simulator ({row['verdict']['status']}: {found})"
        f" {effect(**gain)}, {interval_text(**gain)} over {len(row['seeds'])} seeds of"
        f" {row['plain in reality']['episodes'] // len(row['seeds'])} episodes."
    )
