"""From poses to force per taxel: geometry query, the model's depth stages, and its contact law. Imports
warp."""

from collections.abc import Sequence

import torch

from lerobot_vtrefine.tactile.contact_query import ContactQuery
from lerobot_vtrefine.tactile.foundation import FoundationSolver
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
        self, layout: PadLayout, bodies: Sequence[BodyGeometry], model: SensorModel, solved: bool, device: str
    ) -> None:
        self.layout, self._depth_stages = layout, model.depth_stages
        subdivision = model.contact.subdivision if solved else 1
        self._query = ContactQuery(layout, list(bodies), device, subdivision)
        self._solver = FoundationSolver(layout, device, subdivision) if solved else None
        # A face that is moved needs the gap where it does not touch yet, which only the column query gives.
        self._mode = "column" if model.depth_stages else model.contact.query
        pitch_m = layout.pitch_m / subdivision
        self._lattice = PadLayout(layout.rows * subdivision, layout.cols * subdivision, pitch_m)

    def __call__(
        self, contact: ContactStage, poses: Sequence[torch.Tensor], load: torch.Tensor | None, frame: Frame
    ) -> torch.Tensor:
        """Force per taxel (m, P, R, C) [N] for `contact` with its parameters' values; poses as
        `ContactQuery` takes them."""
        depth, rate = self._query(self._mode, *poses, load=load if self._solver else None)
        on_lattice = Frame(layout=self._lattice, dt_s=frame.dt_s, time_s=frame.time_s)
        for stage in self._depth_stages:
            depth, _ = stage.step(depth, {}, on_lattice)
        if self._solver is None or load is None:
            return contact.force(depth, rate, self.layout)
        window = self._query.window(*load.shape[:2])
        stiffness, lead = (
            self._per_env(value, depth) for value in (contact.stiffness(self.layout), contact.lead_s())
        )
        return self._solver(depth, rate, load, stiffness, lead, window)[0]

    @staticmethod
    def _per_env(value: torch.Tensor | float, like: torch.Tensor) -> torch.Tensor:
        """A number, or one per environment (m, 1, 1, 1), as (m,)."""
        return torch.as_tensor(value, device=like.device).to(like.dtype).reshape(-1).expand(len(like))
