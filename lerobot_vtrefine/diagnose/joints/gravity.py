"""How gravity's pull on each joint depends on posture, up to its size: the shapes that a sag may have.

Angles are taken from the commands: the servo's lag then acts on the sag as it does on the joint. Every shape
is 1 at full horizontal reach, and positive pitch tips the link down, as the ViperX's joints turn.

Shapes: N frames, T trials, J joints, K = `TERMS` numbers per posture (unused ones are zero).
"""

import re
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.embodiments import Embodiment, embodiment_of
from lerobot_vtrefine.embodiments.embodiment import PITCH, YAW
from lerobot_vtrefine.embodiments.robot_file import TERMS

Array = np.ndarray

ONE_TERM_FORMS = ("mass", "reach", "link", "own")
"""Shapes with one free number: link masses, TCP alone, own link alone, own angle alone."""
TWO_TERM_FORM = "arm"
"""Own link and the later ones, each with a mass of its own."""
FREE_FORM = "free"
"""Sines and cosines of the pitch of the own and the next link: any zero angle, any mass distribution."""
FORMS = (*ONE_TERM_FORMS, TWO_TERM_FORM, FREE_FORM)

_LEVEL_OR_SLIDING = re.compile(r"waist|base|pan|yaw|roll|rotat|twist|finger|grip|jaw|slide|prismatic|_x$|_y$")
_SLIDING = re.compile(r"finger|grip|jaw|slide|prismatic")
_PITCHING = re.compile(r"shoulder|elbow|wrist|pitch|lift|flex|tilt")


def is_sliding(joint: str) -> bool:
    """Whether a joint's positions are lengths [m]. A known body says so; of another's, grippers and what is
    called a slide are taken for that."""
    body = embodiment_of((joint,))
    if body is not None:
        return is_gripper(joint) and body.fingers.slide
    return bool(_SLIDING.search(joint.lower()))


def is_gripper(joint: str) -> bool:
    """Whether a joint opens and closes a gripper: a known body says so, else its name."""
    body = embodiment_of((joint,))
    if body is not None:
        return body.joint_of(joint.removesuffix(".pos")) is None
    return bool(re.search(r"finger|grip|jaw", joint.lower()))


@dataclass(frozen=True)
class Chain:
    """The pitching joints of one arm, from the base on (column indices), and their links."""

    joints: tuple[int, ...]
    links: tuple[tuple[float, float], ...]
    """(ahead, up) of each link at angle zero [m]: what the next joint's position is."""
    moments: tuple[tuple[float, float], ...]
    """(ahead, up) of each link's mass times its centre's distance, later links' mass at its end [kg m]."""


def chains(joints: tuple[str, ...]) -> tuple[Chain, ...]:
    """The arms among named joints. A known body tells which of its joints pitch; where its arms do not reach
    within an upright plane, each joint stands alone. Joints of no known body are chained in order within
    their prefix if their names say that they pitch, and stand alone otherwise."""
    names = [name.removesuffix(".pos") for name in joints]
    body = embodiment_of(joints)
    if body is not None:
        if not _reaches_in_a_plane(body):
            arms = [index for index, name in enumerate(names) if body.joint_of(name) is not None]
            return tuple(Chain((index,), ((0.0, 1.0),), ((1.0, 0.0),)) for index in arms)
        found = [_chain(body, names, arm.name) for arm in body.arms]
        return tuple(chain for chain in found if chain.joints)
    eligible = [index for index, name in enumerate(names) if not _LEVEL_OR_SLIDING.search(name.lower())]
    pitching = [index for index in eligible if _PITCHING.search(names[index].lower())]
    if not pitching:
        return tuple(Chain((index,), ((0.0, 1.0),), ((1.0, 0.0),)) for index in eligible)
    groups: dict[str, list[int]] = {}
    for index in pitching:
        side = re.match(r"(left|right|l|r|arm\d*)[_.]", names[index].lower())
        groups.setdefault(side.group(1) if side else "", []).append(index)
    return tuple(
        Chain(tuple(group), ((1.0, 0.0),) * len(group), ((1.0, 0.0),) * len(group))
        for group in groups.values()
    )


def shapes(joints: tuple[str, ...], command: Array) -> dict[str, Array]:
    """Every form's terms for all joints at the commanded postures (N, T, J): form -> (N, T, J, K).

    Joints that gravity does not load (level axes, slides) have zeros throughout.
    """
    out = {form: np.zeros((*command.shape, TERMS)) for form in FORMS}
    for chain in chains(joints):
        pitch = np.cumsum(command[:, :, list(chain.joints)], -1)
        for place, joint in enumerate(chain.joints):
            later = pitch[:, :, place:]
            out["mass"][:, :, joint, 0] = _level_sum(later, chain.moments[place:])
            out["reach"][:, :, joint, 0] = _level_sum(later, chain.links[place:])
            out["link"][:, :, joint, 0] = np.cos(pitch[:, :, place])
            out["own"][:, :, joint, 0] = np.cos(command[:, :, joint])
            links = chain.links[place:]
            out[TWO_TERM_FORM][:, :, joint, 0] = _level_sum(later[..., :1], links[:1])
            if len(links) > 1:
                out[TWO_TERM_FORM][:, :, joint, 1] = _level_sum(later[..., 1:], links[1:])
            for term in range(min(2, later.shape[-1])):
                out[FREE_FORM][:, :, joint, 2 * term] = np.cos(later[:, :, term])
                out[FREE_FORM][:, :, joint, 2 * term + 1] = np.sin(later[:, :, term])
    return out


def decoys(command: Array, session_s: Array, known: Array) -> dict[str, Array]:
    """Shapes of faults that no cause names, to compete with those that one does: form -> (N, T, J, K).

    Args:
        command: (N, T, J).
        session_s: (N, T) time since the session began.
        known: (2,) first and last session time of the trials that models are fitted to [s].
    """
    hours = (session_s - known.mean()) / max(float(np.ptp(known)), 1e-9)
    constant = np.ones_like(command)
    drift = np.broadcast_to(hours[..., None], command.shape)
    terms = {
        "gain": (command,),
        "square": (command**2,),
        "drift": (drift, constant),
        "gain_drift": (command * drift, command),
    }
    out = {}
    for form, columns in terms.items():
        out[form] = np.zeros((*command.shape, TERMS))
        for index, column in enumerate(columns):
            out[form][..., index] = column
    return out


def full_reach(form: str, terms: Array) -> float:
    """Size [rad] at full horizontal reach of a sag with those terms (K,); droop is positive."""
    if form != FREE_FORM:
        return float(np.sum(terms))
    first, second = np.hypot(terms[0], terms[1]), np.hypot(terms[2], terms[3])
    leading = terms[:2] if first >= second else terms[2:]
    # Pitch is positive downwards, so a droop is mostly a positive cosine (or sine, for a link that stands).
    sign = np.sign(leading[np.argmax(np.abs(leading))]) or 1.0
    return float(sign * (first + second))


def _level_sum(pitch: Array, vectors: tuple[tuple[float, float], ...]) -> Array:
    """Horizontal extent of links at those pitches (..., L), as a part of their stretched length."""
    total = sum(np.hypot(*vector) for vector in vectors)
    ahead = sum(
        x * np.cos(pitch[..., index]) + z * np.sin(pitch[..., index]) for index, (x, z) in enumerate(vectors)
    )
    return np.asarray(ahead) / total


def _reaches_in_a_plane(body: Embodiment) -> bool:
    """Whether upright arms turn about the vertical first, and then pitch; later rolls are taken as zero."""
    upright = not any(arm.base_pitch_rad or arm.base_roll_rad for arm in body.arms)
    axes = [joint.axis for joint in body.joints]
    return upright and PITCH in axes and set(axes[: axes.index(PITCH)]) <= {YAW}


def _chain(body: Embodiment, names: list[str], arm: str) -> Chain:
    """The pitching links of one arm: upper arm, forearm, hand of a ViperX; its rolls are taken as zero."""
    pitching = [place for place, joint in enumerate(body.joints) if joint.axis == PITCH]
    wanted = [f"{arm}_{body.joints[place].name}" for place in pitching]
    present = [name for name in wanted if name in names]
    if present != wanted[: len(present)]:
        return Chain((), (), ())
    offsets = [np.array(joint.offset_m) for joint in body.joints]
    links, masses, owns = [], [], []
    for first, after in zip(pitching, [*pitching[1:], len(body.joints)], strict=True):
        own, mass, base = np.zeros(3), 0.0, np.zeros(3)
        for place in range(first, after):
            joint = body.joints[place]
            base = base + (offsets[place] if place > first else 0.0)
            own, mass = own + joint.mass_kg * (np.array(joint.com_m) + base), mass + joint.mass_kg
        last = after == len(body.joints)
        links.append(base + ([body.tcp_offset_m, 0.0, 0.0] if last else offsets[after]))
        masses.append(mass + (body.pads_per_arm * body.fingers.mass_kg if last else 0.0))
        owns.append(own)
    moments = [own + sum(masses[k + 1 :]) * end for k, (own, end) in enumerate(zip(owns, links, strict=True))]
    pairs = [tuple((float(v[0]), float(v[2])) for v in part[: len(present)]) for part in (links, moments)]
    return Chain(tuple(names.index(name) for name in present), *pairs)
