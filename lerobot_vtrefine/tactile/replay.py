"""Run a sensor model over a recorded press, with the code that the simulator runs."""

from collections.abc import Collection
from functools import partial

import numpy as np
import torch

from lerobot_vtrefine.tactile.geometry import BodyGeometry
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.base import Frame
from lerobot_vtrefine.tactile.stages.cover import passed
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift

ArrayLike = np.ndarray | torch.Tensor

NO_BODY_M = -0.5
"""Depths below this mark taxels without a body over them [m]."""
REPLAY_REACH_M = 0.05
"""Gaps and depths in recordings are known this far from the face [m]."""


def column_heights(
    layout: PadLayout, body: BodyGeometry, position_m: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """How far a body lies below the undeformed face at every taxel, along -z: (T, R, C) [m].

    Negative where there is a gap, -1 where no part of the body stands over the taxel.

    Args:
        position_m, rotation: pose of the body's frame in the pad frame, (T, 3) and (T, 3, 3).
    """
    from lerobot_vtrefine.tactile.contact_query import ContactQuery  # warp is slow to import

    frames = len(position_m)
    query = ContactQuery(layout, [body], "cpu", reach_m=REPLAY_REACH_M)
    still = torch.zeros((frames, 1, 6))
    heights, _ = query(
        "column",
        torch.zeros((frames, 1, 3)),
        torch.eye(3).expand(frames, 1, 3, 3),
        still,
        torch.as_tensor(position_m, dtype=torch.float32)[:, None],
        torch.as_tensor(rotation, dtype=torch.float32)[:, None],
        still,
    )
    return heights[:, 0].numpy().copy()


def finite_rate(times_s: torch.Tensor, depth_m: torch.Tensor) -> torch.Tensor:
    """Central differences of depth (T, ..., R, C) over time (T,) [m/s]; steps without duration count as rest.

    Between a frame with a body over the taxel and one without (-1 m), only the penetration changes.
    """
    if len(times_s) < 2:
        return torch.zeros_like(depth_m)
    times = times_s.to(depth_m.dtype)
    step = (times[1:] - times[:-1]).view(-1, *(1,) * (depth_m.ndim - 1))
    later, earlier = depth_m[1:], depth_m[:-1]
    known = (later > NO_BODY_M) & (earlier > NO_BODY_M)
    change = torch.where(known, later - earlier, later.clamp(min=0.0) - earlier.clamp(min=0.0))
    slope = torch.where(step > 0, change / step.clamp(min=1e-9), torch.zeros_like(change))
    return torch.cat([slope[:1], 0.5 * (slope[1:] + slope[:-1]), slope[-1:]])


def _spread_over_trials(
    borne: tuple[ArrayLike, ArrayLike, ArrayLike], x: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None:
    """(J, R, C) each as (J, ..., R, C) beside x (T, ..., R, C); None if nothing was borne."""
    drive, age_s, path = (torch.as_tensor(values, device=x.device).to(torch.float64) for values in borne)
    if not len(drive):
        return None
    shape = (len(drive), *(1,) * (x.ndim - 3), *drive.shape[-2:])
    return drive.reshape(shape), age_s.reshape(shape), path.reshape(shape)


def _checked_layout(x: torch.Tensor, count: int, layout: PadLayout | None) -> PadLayout:
    """The layout, or that of the arrays' shape; ValueError where they disagree."""
    if x.ndim < 3 or len(x) != count:
        raise ValueError(f"replay needs arrays (T, ..., R, C) with T = {count} times, got {tuple(x.shape)}")
    layout = layout or PadLayout(x.shape[-2], x.shape[-1])
    if (layout.rows, layout.cols) != tuple(x.shape[-2:]):
        raise ValueError(f"replay got {tuple(x.shape[-2:])} taxels for a {layout.rows} x {layout.cols} pad")
    return layout


def _forces(
    model: SensorModel, depth: torch.Tensor, rate: torch.Tensor, layout: PadLayout
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """The contact's force, and the part of it that damping bears, where a stage asks for it."""
    force = model.contact.force(depth, rate, layout)
    if not model.parts_forces:
        return force, None
    return force, force - model.contact.undamped().force(depth, rate, layout)


def replay(
    model: SensorModel,
    times_s: ArrayLike,
    depth_m: ArrayLike | None = None,
    rate_m_s: ArrayLike | None = None,
    *,
    force_n: ArrayLike | None = None,
    layout: PadLayout | None = None,
    start_s: float = 0.0,
    temperature_c: ArrayLike | None = None,
    borne: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    skip: Collection[str] = ("noise", "quantisation"),
) -> torch.Tensor:
    """Readings that the model predicts for one trial, or for several with the same times: (T, ..., R, C)
    float32 counts.

    Give either the depth of every taxel (column height, see docs/recording-format.md), or force per taxel,
    which then replaces the contact model and everything before it.

    Args:
        times_s: (T,) non-decreasing, from the trial's start [s].
        depth_m: (T, ..., R, C) signed depth; -1 where there is no body.
        rate_m_s: its rate; central differences by default.
        force_n: (T, ..., R, C) force per taxel [N].
        start_s: session time of the trial's first frame, for drift [s].
        temperature_c: (T,) where it was recorded, for drift [degrees Celsius].
        borne: what earlier recordings pressed the taxels with, how long before, and along what path, where
            that is known: drive, age and path (J, R, C) each, as `Frame.borne` has them.
        skip: stages left out; by default those that only add noise to a prediction.

    Raises:
        ValueError: neither or both of depth and force, or shapes that disagree.
    """
    if (depth_m is None) == (force_n is None):
        raise ValueError("replay needs exactly one of depth_m and force_n")
    times = torch.as_tensor(np.asarray(times_s), dtype=torch.float64)
    x = torch.as_tensor(depth_m if force_n is None else force_n).to(torch.float32)
    layout = _checked_layout(x, len(times), layout)
    frame = Frame(
        layout,
        stiffness_n_per_m=model.contact.stiffness(layout),
        temperature_c=None if temperature_c is None else torch.as_tensor(temperature_c),
        load_conserving=force_n is not None,
        borne=None if borne is None else _spread_over_trials(borne, x),
    )
    damping = None
    if force_n is None:
        given = None if rate_m_s is None else torch.as_tensor(rate_m_s).to(x.dtype)
        rate = finite_rate(times, x) if given is None else given
        for stage in model.depth_stages:
            x = stage.sequence(x, times, frame) if stage.name not in skip else x
        x, damping = _forces(model, x, rate, layout)
    for stage in model.force_stages:
        if stage.name not in skip and not stage.stochastic:
            session = times + start_s if isinstance(stage, BaselineDrift) and not stage.anew else times
            x, damping = passed(stage, x, damping, partial(stage.sequence, times_s=session, frame=frame))
    return x
