"""The benchmark's sets: groups of specifications and seeds."""

import zlib
from dataclasses import dataclass

from hidden.catalogue import CAUSES, FORMS, PAIRS, TRIPLES, visible
from hidden.session import Spec

SIZES = (0.5, 1.0, 2.0)
TUNE_SEED, REPORT_SEED = 0, 1000
CROWDED = (
    "crosstalk",
    "mechanical_spreading",
    "latency",
    "scan_skew",
    "contact_offset",
    "nonlinear_stiffness",
)
"""Causes that a single press at a single speed confuses with others."""


@dataclass(frozen=True)
class Case:
    """One set of the benchmark; `name` is its file in the cache."""

    group: str
    label: str
    spec: Spec
    seed: int

    @property
    def name(self) -> str:
        return f"{self.group}-{self.label}-{self.seed}"


def _case(group: str, label: str, spec: Spec, first: int, i: int) -> Case:
    # Seeds differ between cells too: a specimen and a protocol are never shared by two cells.
    return Case(group, label, spec, first + i + 10_000 * (zlib.crc32(f"{group}{label}".encode()) % 9000))


def contract_forms(per_cell: int, first: int) -> list[Case]:
    return [
        _case(
            "single",
            f"{cause}-{next(iter(FORMS[cause]))}-{size}",
            Spec("4x4", ((cause, form, size),)),
            first,
            i,
        )
        for cause in CAUSES
        for form in [next(iter(FORMS[cause]))]
        for size in SIZES
        for i in range(per_cell)
    ]


def other_forms(per_cell: int, first: int) -> list[Case]:
    return [
        _case("form", f"{cause}-{form}-{size}", Spec("4x4", ((cause, form, size),)), first, i)
        for cause in CAUSES
        for form in list(FORMS[cause])[1:]
        for size in SIZES[1:]
        for i in range(per_cell)
    ]


def clean(count: int, first: int) -> list[Case]:
    return [_case("clean", "4x4", Spec("4x4"), first, i) for i in range(count)]


def nasty(count: int, first: int) -> list[Case]:
    noises = ("repeatability", "red", "tails", "sites")
    return [_case("nasty", n, Spec("4x4", noise=n), first, i) for n in noises for i in range(count)]


def compositions(per_cell: int, first: int) -> list[Case]:
    def spec(names: tuple[str, ...]) -> Spec:
        return Spec("4x4", tuple((n, next(iter(FORMS[n])), 1.5) for n in names))

    return [
        _case("composition", "+".join(names), spec(names), first, i)
        for names in (*PAIRS, *TRIPLES)
        for i in range(per_cell)
    ]


def outside(per_cell: int, first: int) -> list[Case]:
    return [
        _case("outside", f"{form}-{size}", Spec("4x4", (("outside", form, size),)), first, i)
        for form in FORMS["outside"]
        for size in SIZES[1:]
        for i in range(per_cell)
    ]


def undecidable(per_cell: int, first: int) -> list[Case]:
    """One speed, one depth, one site; and the same pads after four conditions more."""
    return [
        _case(group, name, Spec("4x4", ((name, next(iter(FORMS[name])), 2.0),), protocol=protocol), first, i)
        for group, protocol in (("undecidable", "monotone"), ("decided", "monotone_and_more"))
        for name in CROWDED
        for i in range(per_cell)
    ]


def rigs(per_cell: int, first: int) -> list[Case]:
    """Other pads, indenters, drives and frame rates."""
    out = []
    for rig in ("1x1", "1x1_force", "4x4_fast", "4x4_small", "4x4_large", "8x8", "8x8_force"):
        out += [_case("rig_clean", rig, Spec(rig), first, i) for i in range(per_cell)]
        for cause in CAUSES:
            if visible(cause, rig):
                effect = (cause, next(iter(FORMS[cause])), 1.5)
                out += [
                    _case("rig", f"{rig}-{cause}", Spec(rig, (effect,)), first, i) for i in range(per_cell)
                ]
    return out


def large(per_cell: int, first: int) -> list[Case]:
    """The real pad's size."""
    some = ("row_sharing", "hysteresis", "taxel_gain_spread", "latency", "baseline_drift", "crosstalk")
    out = [_case("large_clean", "12x32", Spec("12x32"), first, i) for i in range(per_cell)]
    for cause in some:
        effect = (cause, next(iter(FORMS[cause])), 1.5)
        out += [_case("large", f"12x32-{cause}", Spec("12x32", (effect,)), first, i) for i in range(per_cell)]
    return out


GROUPS = {
    "single": (contract_forms, 5),
    "form": (other_forms, 3),
    "clean": (clean, 200),
    "nasty": (nasty, 60),
    "composition": (compositions, 10),
    "outside": (outside, 4),
    "undecidable": (undecidable, 8),
    "rig": (rigs, 1),
    "large": (large, 1),
}
"""Name -> function and its count in a full run."""
