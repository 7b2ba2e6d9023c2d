"""What the policy sees of its observation: features of the cloud, of the pads and of the joints, per frame.

Shapes: ``B`` batch, ``To`` observation steps, ``N`` points, ``P`` pads, ``R`` x ``C`` taxels.
"""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_vtrefine.datasets.features import CLOUD_KEY, GRIDS_KEY, PAD_COLS, PAD_ROWS, STATE_KEY
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.pad_encoder import PadEncoder
from lerobot_vtrefine.policies.vt_dp3.point_encoder import PointEncoder

STATE_FEATURES = 64
ENCODER_FILE = "encoder.safetensors"


class ObservationEncoder(nn.Module):
    """To frames -> condition (B, ``cond_dim``): the features of every frame, side by side.

    ``points`` or ``pads`` may be None; joint positions are always seen.
    """

    def __init__(
        self,
        points: PointEncoder | None,
        pads: PadEncoder | None,
        state_dim: int,
        n_obs_steps: int,
    ) -> None:
        super().__init__()
        self.points = points
        self.pads = pads
        self.state = nn.Sequential(
            nn.Linear(state_dim, STATE_FEATURES), nn.ReLU(), nn.Linear(STATE_FEATURES, STATE_FEATURES)
        )
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
        return (*(key for key, part in read if part is not None), STATE_KEY)

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """Cloud (B, To, N, 5) in metres, readings (B, To, P, R, C), normalised state (B, To, Ds)."""
        state = batch[STATE_KEY]
        frames = [
            part(batch[key].flatten(0, 1)).unflatten(0, state.shape[:2])
            for key, part in ((CLOUD_KEY, self.points), (GRIDS_KEY, self.pads))
            if part is not None
        ]
        return torch.cat([*frames, self.state(state)], dim=-1).flatten(1)


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
        pads = PadEncoder(len(body.pad_names), (PAD_ROWS, PAD_COLS), config.pad_width, config.pad_features)
    return ObservationEncoder(points, pads, state_dim, config.n_obs_steps)


def save_encoder(encoder: ObservationEncoder, folder: Path) -> None:
    """Write the networks of cloud and pads; that of the joints depends on a dataset's normalisation."""
    weights = {name: value.contiguous() for name, value in _perception_weights(encoder).items()}
    folder.mkdir(parents=True, exist_ok=True)
    save_file(weights, folder / ENCODER_FILE)


def load_encoder(encoder: ObservationEncoder, folder: Path) -> None:
    """Start from the networks that ``save_encoder`` wrote.

    Raises:
        FileNotFoundError: the folder holds no encoder. ValueError: it fits another policy, or is damaged.
    """
    path = folder / ENCODER_FILE
    if not path.is_file():
        raise FileNotFoundError(f"--policy.pretrained_encoder={folder} holds no {ENCODER_FILE}")
    try:
        weights = load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    own = _perception_weights(encoder)
    if {name: value.shape for name, value in own.items()} != {k: v.shape for k, v in weights.items()}:
        raise ValueError(
            f"{path} was trained for other networks: give --policy.modalities, --policy.fusion and"
            " --policy.preset as vtrefine-information had them"
        )
    encoder.load_state_dict(weights, strict=False)


def _perception_weights(encoder: ObservationEncoder) -> dict[str, Tensor]:
    return {name: value for name, value in encoder.state_dict().items() if not name.startswith("state.")}
