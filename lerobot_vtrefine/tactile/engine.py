"""From poses to force per taxel: geometry query, the model's depth stages, and its contact law. Imports
warp."""

from collections.abc import Sequence

import torch

from lerobot_vtrefine.tactile.contact_query import ContactQuery
from lerobot_vtrefine.tactile.foundation import ContactSolver
from lerobot_vtrefine.tactile.geometry import BodyGeometry
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.base import Frame
from lerobot_vtrefine.tactile.stages.contact import ContactStage


class ContactEngine:
    """The contact half of a sensor model on one device.

    Args:
        solved: whether forces are solved for a load (needs a contact stage that conserves it).
    """

    def __init__(
        self,
        layout: PadLayout,
        bodies: Sequence[BodyGeometry],
        model: SensorModel,
        solved: bool,
        device: str,
        num_threads: int = 1,
    ) -> None:
        self.layout, self._depth_stages, self._solved = layout, model.depth_stages, solved
        subdivision = model.contact.subdivision if solved else 1
        self._query = ContactQuery(layout, list(bodies), device, subdivision)
        self._solver = ContactSolver(layout, self._query, num_threads)
        # A face that is moved needs the gap where it does not touch yet, which only the column query gives.
        self._mode = "column" if model.depth_stages else model.contact.query
        pitch_m = layout.pitch_m / subdivision
        self._lattice = PadLayout(layout.rows * subdivision, layout.cols * subdivision, pitch_m)

    def __call__(
        self, contact: ContactStage, poses: Sequence[torch.Tensor], load: torch.Tensor | None, frame: Frame
    ) -> torch.Tensor:
        """Force per taxel (m, P, R, C) [N] for `contact` with its parameters' values; poses as
        `ContactQuery` takes them. A reused buffer."""
        poses, solved = tuple(poses), self._solved and load is not None
        stiffness = contact.stiffness(self.layout)
        if not self._depth_stages and not solved:
            damping, ceiling = contact.damping(self.layout), contact.ceiling()
            return self._solver.penalty(self._mode, poses, stiffness, damping, ceiling)
        heights = self._moved_face(poses, load if solved else None, frame) if self._depth_stages else None
        if not solved or load is None:
            assert heights is not None
            return contact.force(*heights, self.layout)
        return self._solver.foundation(poses, load, stiffness, contact.lead_s(), heights)[0]

    def _moved_face(
        self, poses: tuple[torch.Tensor, ...], load: torch.Tensor | None, frame: Frame
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Depth and rate after the model's depth stages."""
        depth, rate = self._query(self._mode, *poses, load=load)
        on_lattice = Frame(layout=self._lattice, dt_s=frame.dt_s, time_s=frame.time_s)
        for stage in self._depth_stages:
            depth, _ = stage.step(depth, {}, on_lattice)
        return depth, rate
