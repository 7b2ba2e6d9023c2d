"""What the policy sees of its observation: features of the cloud, of the pads and of the joints, per frame.

Shapes: ``B`` batch, ``To`` observation steps, ``N`` points, ``P`` pads, ``R`` x ``C`` taxels.
"""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_vtrefine import shipped
from lerobot_vtrefine.datasets.features import CLOUD_KEY, GRIDS_KEY, LIMITS_KEY, STATE_KEY
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.files.weights import naming_full_disk
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.pad_encoder import PadEncoder
from lerobot_vtrefine.policies.vt_dp3.point_encoder import PointEncoder

STATE_FEATURES = 64
PERCEIVED_KEY = "perceived"
"""Of a batch whose frames a frozen encoder has seen before."""
ENCODER_FLAG = "--policy.pretrained_encoder"
FRAMES_AT_ONCE = 2048
"""Without gradients: 1024 worlds of two frames. More frames make layers of points that take gigabytes."""


class ObservationEncoder(nn.Module):
    """To frames -> condition (B, ``cond_dim``): the features of every frame, side by side.

    ``points`` or ``pads`` may be None; joint positions are always seen, limits where they are told.
    """

    def __init__(
        self,
        points: PointEncoder | None,
        pads: PadEncoder | None,
        state_dim: int,
        n_obs_steps: int,
        limits_dim: int = 0,
    ) -> None:
        super().__init__()
        self.points = points
        self.pads = pads
        self.state = nn.Sequential(
            nn.Linear(state_dim + limits_dim, STATE_FEATURES),
            nn.ReLU(),
            nn.Linear(STATE_FEATURES, STATE_FEATURES),
        )
        self.limits_dim = limits_dim
        seen = sum(part.out_dim for part in (points, pads) if part is not None)
        self.cond_dim = n_obs_steps * (seen + STATE_FEATURES)

    @property
    def perception(self) -> tuple[nn.Module, ...]:
        """The networks of cloud and pads: what can be trained before there is a policy."""
        return tuple(part for part in (self.points, self.pads) if part is not None)

    @property
    def keys(self) -> tuple[str, ...]:
        """Columns of a processed batch that are read."""
        read = ((CLOUD_KEY, self.points), (GRIDS_KEY, self.pads))
        limit = [LIMITS_KEY] if self.limits_dim else []
        return (*(key for key, part in read if part is not None), *limit, STATE_KEY)

    def inputs(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """What is read of a processed batch.

        Raises:
            ValueError: it lacks a column.
        """
        if missing := [key for key in self.keys if key not in batch]:
            hint = (
                ": --env.randomization.contact_force_n='[5, 5]' states limits"
                if LIMITS_KEY in missing
                else ""
            )
            raise ValueError(f"the policy's input lacks {', '.join(missing)}, which it learned with{hint}")
        return {key: batch[key] for key in self.keys}

    def perceive(self, batch: dict[str, Tensor]) -> Tensor:
        """Features (B, To, F) of cloud (B, To, N, 5) in metres and readings (B, To, P, R, C); F may be 0."""
        frames = [
            _frame_by_frame(part, batch[key].flatten(0, 1)).unflatten(0, batch[STATE_KEY].shape[:2])
            for key, part in ((CLOUD_KEY, self.points), (GRIDS_KEY, self.pads))
            if part is not None
        ]
        return torch.cat(frames, dim=-1) if frames else batch[STATE_KEY][..., :0]

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """Cloud (B, To, N, 5) in metres, readings (B, To, P, R, C), normalised state (B, To, Ds) and limits
        (B, To, 2); with ``PERCEIVED_KEY``, what ``perceive`` made of cloud and readings, these are not read.
        """
        known = batch.get(PERCEIVED_KEY)
        if known is None:
            batch = self.inputs(batch)
            known = self.perceive(batch)
        state = batch[STATE_KEY]
        if self.limits_dim:
            state = torch.cat([state, batch[LIMITS_KEY]], dim=-1)
        return torch.cat([known, self.state(state)], dim=-1).flatten(1)


def _frame_by_frame(part: nn.Module, frames: Tensor) -> Tensor:
    """``part`` of frames (M, ...), a few at a time where nothing is kept for a gradient."""
    if torch.is_grad_enabled() or len(frames) <= FRAMES_AT_ONCE:
        return part(frames)
    return torch.cat([part(few) for few in frames.split(FRAMES_AT_ONCE)])


def make_encoder(config: VtDp3Config, state_dim: int) -> ObservationEncoder:
    """The encoder that a policy's settings describe.

    With ``fusion=pads`` the cloud holds visual points only, and is missing where the policy sees touch only.
    """
    view = config.observation
    points = pads = None
    if config.cloud_modalities:
        points = PointEncoder(config.point_dims, config.point_features, view.center_m, view.scale_m)
    if config.sees_grids:
        body = get_embodiment(view.embodiment)
        shape = body.pad_layout.rows, body.pad_layout.cols
        pads = PadEncoder(len(body.pad_names), shape, config.pad_width, config.pad_features)
    return ObservationEncoder(points, pads, state_dim, config.n_obs_steps, config.limits_dim)


def encoder_file(config: VtDp3Config) -> str:
    """Name of the weights of an encoder with these senses, below a folder of encoders."""
    touch = "" if config.modalities == "visual" else f"_{config.fusion}"
    return f"encoder_{config.modalities}{touch}.safetensors"


def save_encoder(encoder: ObservationEncoder, config: VtDp3Config, folder: Path) -> None:
    """Write the networks of cloud and pads; that of the joints depends on a dataset's normalisation.

    Raises: OSError where the disk is full; names the file.
    """
    weights = {name: value.contiguous() for name, value in _perception_weights(encoder).items()}
    path = folder / encoder_file(config)
    with naming_full_disk(path):
        save_file(weights, path)


def load_encoder(encoder: ObservationEncoder, config: VtDp3Config) -> None:
    """Start from the networks that ``save_encoder`` wrote to the folder ``config.pretrained_encoder``, or
    from those that come with the package under the name ``vtrefine:TASK``.

    Raises:
        FileNotFoundError: the folder holds no such encoder.
        ValueError: it fits another policy, is damaged, or nothing of this name comes with the package.
    """
    name = config.pretrained_encoder
    folder = shipped.find(ENCODER_FLAG, name) if name.startswith(shipped.PREFIX) else Path(name)
    path = folder / encoder_file(config)
    if not path.is_file():
        held = sorted(item.name for item in folder.glob("encoder_*.safetensors"))
        known = ", ".join(shipped.PREFIX + task for task in shipped.encoders())
        raise FileNotFoundError(
            f"{ENCODER_FLAG}={name} holds no {path.name}"
            f" (but {', '.join(held) or 'no encoder'}): make it with vtrefine-information, or use {known}"
        )
    try:
        weights = load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    own = {key: value.shape for key, value in _perception_weights(encoder).items()}
    if own != {key: value.shape for key, value in weights.items()}:
        raise ValueError(
            f"{path} was trained for networks of other sizes: give --policy.preset, and whatever else changes"
            " them, as vtrefine-information had it"
        )
    encoder.load_state_dict(weights, strict=False)


def _perception_weights(encoder: ObservationEncoder) -> dict[str, Tensor]:
    return {name: value for name, value in encoder.state_dict().items() if not name.startswith("state.")}
