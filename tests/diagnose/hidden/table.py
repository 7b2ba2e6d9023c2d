"""The benchmark's table: proportions and quantiles with 95 % intervals, beside the bars."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

Row = dict[str, Any]


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % score interval of a proportion."""
    if count == 0:
        return 0.0, 1.0
    z, p = 1.959964, hits / count
    centre, spread = p + z * z / (2 * count), z * np.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    low, high = ((centre + sign * spread) / (1 + z * z / count) for sign in (-1, 1))
    return max(float(low), 0.0), min(float(high), 1.0)


def quantile_interval(values: np.ndarray, q: float) -> tuple[float, float, float]:
    """A quantile and its 95 % bootstrap interval."""
    rng = np.random.default_rng(0)
    draws = np.quantile(rng.choice(values, (2000, len(values))), q, axis=1)
    return float(np.quantile(values, q)), *(float(v) for v in np.quantile(draws, [0.025, 0.975]))


def share(rows: Iterable[Row], hit: Callable[[Row], bool]) -> tuple[int, str]:
    """Count, and the share with its interval, as text."""
    flags = [bool(hit(row)) for row in rows]
    low, high = wilson(sum(flags), len(flags))
    return len(flags), f"{sum(flags) / len(flags):.3f} [{low:.3f}, {high:.3f}]" if flags else "-"


def spread(values: Iterable[float], q: float) -> tuple[int, str]:
    found = np.array([v for v in values if v is not None and np.isfinite(v)])
    if not len(found):
        return 0, "-"
    value, low, high = quantile_interval(found, q)
    return len(found), f"{value:.3f} [{low:.3f}, {high:.3f}]"


def band(rows: list[Row], low: float, high: float) -> list[Row]:
    return [row for row in rows if low <= row["oracle_gain"] < high]


def lines(rows: list[Row], pick: Callable[[Row], Row] = lambda row: row) -> list[tuple[str, int, str, str]]:
    """Metric, n, value with interval, bar. `pick` selects an analyst's grade from a row."""
    of = {group: [r for r in rows if r["group"] == group] for group in {r["group"] for r in rows}}

    def group(*names: str) -> list[Row]:
        return [row for name in names for row in of.get(name, [])]

    def says(key: str) -> Callable[[Row], bool]:
        return lambda row: bool(pick(row).get(key))

    def kind(*kinds: str) -> Callable[[Row], bool]:
        return lambda row: pick(row)["kind"] in kinds

    not_adequate = lambda row: pick(row)["kind"] != "exact"  # noqa: E731
    single, forms = group("single", "rig", "large"), group("form")
    seen = [r for r in single + forms if r["oracle_gain"] >= 0.05]
    out = [
        ("exact, single, gain >= .2", *share(band(single, 0.2, 2), says("exact")), ">= .95"),
        ("exact, single, gain .1-.2", *share(band(single, 0.1, 0.2), says("exact")), ">= .85"),
        ("exact, single, gain .03-.1", *share(band(single, 0.03, 0.1), says("exact")), "power"),
        ("wrong first name, all levels", *share(single + forms, says("wrong_first")), "<= .02"),
        ("other form: right first, gain >= .2", *share(band(forms, 0.2, 2), says("first_right")), ".984*"),
        ("other form: exact, gain >= .2", *share(band(forms, 0.2, 2), says("exact")), ".76*"),
        ("clean: false alarm", *share(group("clean"), not_adequate), "<= .03 (up <= .06)"),
        ("clean, other rigs: false alarm", *share(group("rig_clean", "large_clean"), not_adequate), "<= .03"),
        ("nasty clean: false alarm", *share(group("nasty"), not_adequate), "<= .06"),
    ]
    for noise in ("repeatability", "red", "tails", "sites"):
        chosen = [row for row in group("nasty") if row["label"] == noise]
        out.append((f"  {noise}", *share(chosen, not_adequate), ""))
    mixed, strange = group("composition"), [r for r in group("outside") if r["oracle_gain"] >= 0.1]
    out += [
        ("composition: exact set", *share(mixed, says("exact")), ">= .90"),
        ("composition: recall", len(mixed), mean([pick(r).get("recall", 0.0) for r in mixed]), ">= .95"),
        ("composition: precision", len(mixed), mean([pick(r).get("precision", 0.0) for r in mixed]), ".99*"),
        ("outside, gain >= .1: flagged unknown", *share(strange, says("exact")), ">= .95"),
        ("outside, all: confident wrong name", *share(group("outside"), kind("wrong")), "<= .02"),
        ("undecidable: truth in the set given", *share(group("undecidable"), says("in_set")), ">= .95"),
        ("undecidable: confidently wrong", *share(group("undecidable"), says("wrong_first")), ""),
        ("  after four conditions more: exact", *share(group("decided"), says("exact")), ">= .95"),
        ("engine exceptions, invalid_data", *share(rows, kind("error", "invalid")), "0"),
    ]
    return out + (numbers(rows, seen + mixed) if pick(rows[0]) is rows[0] else [])


def mean(values: list[float]) -> str:
    return f"{np.mean(values):.3f}" if values else "-"


def numbers(rows: list[Row], seen: list[Row]) -> list[tuple[str, int, str, str]]:
    """Rows that only an engine with models, parameters and intervals can fill."""
    visible = [row for row in seen if row["oracle_gain"] >= 0.1 and row.get("gain") is not None]
    ratio = [row["gain"] / row["oracle_gain"] for row in visible]
    exact = [row for row in visible if row["exact"]]
    errors = [value for row in exact for value in row["errors"].values()]
    covered = [{"hit": value} for row in exact for value in row["covered"].values()]
    small = [row["cpu_s"] for row in rows if row["rig"] == "4x4" and "cpu_s" in row]
    big = [row["cpu_s"] for row in rows if row["rig"].startswith("12x32") and "cpu_s" in row]
    return [
        ("gain / oracle gain, median", *spread(ratio, 0.5), ">= .97"),
        ("gain / oracle gain, p10", *spread(ratio, 0.1), ">= .90"),
        ("parameter error, median", *spread(errors, 0.5), ".03*"),
        ("parameter error, p90", *spread(errors, 0.9), "<= .20"),
        ("95 % interval coverage", *share(covered, lambda row: row["hit"]), ".90-.98"),
        ("CPU seconds, 4x4 x 24 trials, median", *spread(small, 0.5), "~1"),
        ("CPU seconds, 12x32 x 24 trials, max", *spread(big, 1.0), "<= 60"),
    ]


def render(rows: list[Row]) -> str:
    """The whole table, with the naive analysts' columns where they were run on the same sets."""
    compared = [row for row in rows if "bic_stepwise" in row]
    out = [f"{'metric':42s} {'n':>5s}  {'value [95 % CI]':24s} bar   (* prototype's figure)"]
    out += [f"{name:42s} {n:5d}  {value:24s} {bar}" for name, n, value, bar in lines(rows) if n]
    if compared:
        out += ["", f"On the {len(compared)} sets that the naive analysts saw too:"]
        out += [f"{'metric':42s} {'n':>5s}  {'engine':24s} {'BIC stepwise':24s} free refit"]
        tables = [lines(compared, pick) for pick in (dict, analyst("bic_stepwise"), analyst("free_refit"))]
        for (name, n, ours, _), (_, _, bic, _), (_, _, free, _) in zip(*tables, strict=True):
            out += [f"{name:42s} {n:5d}  {ours:24s} {bic:24s} {free}"] if n else []
    return "\n".join(out)


def analyst(name: str) -> Callable[[Row], Row]:
    return lambda row: row[name]


def failures(rows: list[Row]) -> list[str]:
    """One line for every set that was not answered exactly, worst first."""
    bad = [row for row in rows if not row.get("exact") and not (row["causes"] and row["oracle_gain"] < 0.05)]
    bad.sort(key=lambda row: (-row["oracle_gain"], row["label"]))
    return [
        f"{row['group']}-{row['label']}-{row['seed']}: gain {row['oracle_gain']:.2f} {row['kind']}"
        f" -> {row.get('error') or ', '.join(row.get('named', ())) or '-'}"
        for row in bad
    ]


DOCUMENT = (
    ("one cause, achievable gain above .2: exact verdict", ("exact, single, gain >= .2",), ".95"),
    (
        "one cause, gain .1 to .2; .03 to .1: exact verdict",
        ("exact, single, gain .1-.2", "exact, single, gain .03-.1"),
        ".85; -",
    ),
    ("one cause, any strength: wrong name first", ("wrong first name, all levels",), ".02"),
    (
        "the cause has another functional form: right name first",
        ("other form: right first, gain >= .2",),
        "",
    ),
    (
        "nothing wrong: false alarm; the same with nasty noise",
        ("clean: false alarm", "nasty clean: false alarm"),
        ".03; .06",
    ),
    (
        "two or three causes: exact set; recall",
        ("composition: exact set", "composition: recall"),
        ".90; .95",
    ),
    (
        "an effect that no catalogue lists: said to be unknown; confidently misnamed",
        ("outside, gain >= .1: flagged unknown", "outside, all: confident wrong name"),
        ".95; .02",
    ),
    (
        "the design cannot tell: truth among the names; exact after four more conditions",
        ("undecidable: truth in the set given", "  after four conditions more: exact"),
        ".95",
    ),
    (
        "gain on locked recordings / the true model's: median; worst tenth",
        ("gain / oracle gain, median", "gain / oracle gain, p10"),
        ".97; .90",
    ),
    (
        "relative parameter error: median; worst tenth",
        ("parameter error, median", "parameter error, p90"),
        ".20",
    ),
    ("95 % intervals that hold the truth", ("95 % interval coverage",), ".90-.98"),
    (
        "12 x 32 taxels, 24 recordings, one core: most seconds",
        ("CPU seconds, 12x32 x 24 trials, max",),
        "60",
    ),
)
"""Lines of the documents' table: words, the metrics that they show, and the bar."""


def document(rows: list[Row], before: dict[str, dict[str, str]]) -> str:
    """The documents' table in Markdown, beside the figures of earlier commits: head -> (words -> figures)."""
    found = {name: (n, value) for name, n, value, _ in lines(rows)}
    body = [["", "sets", "engine", *before, "bar"]]
    for words, names, bar in DOCUMENT:
        counts = "; ".join(dict.fromkeys(str(found[name][0]) for name in names))
        values = "; ".join(found[name][1] for name in names)
        body.append([words, counts, values, *(old.get(words, "") for old in before.values()), bar])
    text = ["| " + " | ".join(cells) + " |" for cells in body]
    return "\n".join([text[0], "|---" * len(body[0]) + "|", *text[1:]])
