"""The reference's diffusion network, with which both implementations begin.

As ``cfg/gym/pretrain/hopper-medium-v2/pre_diffusion_mlp.yaml`` of the checkout has it; in ``hopper-v2`` it
is the same. It sees the scaled observation and acts in scaled chunks.
"""

from pathlib import Path

import torch
from torch import nn

from reference.checkout import Reference
from reference.hopper.worlds import ACTION_DIM, CHUNK, OBS_DIM

DENOISING_STEPS, TUNED_STEPS = 20, 10


def fresh(reference: Reference) -> nn.Module:
    """One that has learned nothing."""
    return reference.Network(
        action_dim=ACTION_DIM,
        horizon_steps=CHUNK,
        cond_dim=OBS_DIM,
        time_dim=16,
        mlp_dims=[512, 512, 512],
        activation_type="ReLU",
        residual_style=True,
    )


def pretrained(reference: Reference, checkpoint: Path, device: str) -> nn.Module:
    """The network of a checkpoint that ``pretrain`` made."""
    weights = torch.load(checkpoint, map_location=device, weights_only=True)["ema"]
    made = fresh(reference).to(device)
    made.load_state_dict({key.removeprefix("network."): value for key, value in weights.items()})
    return made


def imitation(reference: Reference, device: str) -> nn.Module:
    """Its diffusion model around a fresh network, for imitation."""
    return reference.Imitation(
        network=fresh(reference),
        horizon_steps=CHUNK,
        obs_dim=OBS_DIM,
        action_dim=ACTION_DIM,
        denoising_steps=DENOISING_STEPS,
        predict_epsilon=True,
        denoised_clip_value=1.0,
        device=device,
    )
