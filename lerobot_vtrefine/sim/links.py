"""Pieces of links: what is only seen, what collides, and servos."""

import mujoco
import numpy as np

from lerobot_vtrefine.embodiments.shapes import Shape
from lerobot_vtrefine.sim.appearance import DARK, GREY, Rgba

# Collision classes as bits: each geom carries its own, and is tested against those it names.
TABLE, PLUG, SOCKET, FIRST_HAND, SECOND_HAND = (1 << bit for bit in range(5))
HANDS = (FIRST_HAND, SECOND_HAND)
_COLOURS = {"dark": DARK, "grey": GREY}
_KINDS = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}


def add_shape(body: mujoco.MjsBody, shape: Shape) -> None:
    """A piece that is only seen."""
    rgba = _COLOURS[shape.colour]
    if shape.kind == "capsule":
        ends = np.concatenate(shape.ends_m)
        size = [*shape.size_m, 0, 0]
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=size, rgba=rgba)
    else:
        size = [*shape.size_m, 0][:3]
        geom = body.add_geom(type=_KINDS[shape.kind], size=size, pos=shape.centre_m, rgba=rgba)
    geom.contype = geom.conaffinity = 0
    geom.group = 1


def add_solid(
    body: mujoco.MjsBody, hand: int, name: str, size: list[float], pos: list[float], rgba: Rgba
) -> mujoco.MjsGeom:
    """A box of hand number `hand` that collides."""
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, rgba=rgba)
    geom.contype = HANDS[hand]
    # A hand meets the table and the hands before it; parts name the hands on their side.
    geom.conaffinity = TABLE | sum(HANDS[:hand])
    return geom


def add_servo(
    spec: mujoco.MjSpec,
    name: str,
    target: str,
    kind: mujoco.mjtTrn,
    gain: float,
    force: float,
    span: tuple[float, float],
) -> None:
    """A position servo on a joint or a tendon."""
    servo = spec.add_actuator(name=name, target=target, trntype=kind)
    servo.set_to_position(kp=gain)
    servo.forcerange, servo.forcelimited = [-force, force], True
    servo.ctrlrange, servo.ctrllimited = list(span), True
