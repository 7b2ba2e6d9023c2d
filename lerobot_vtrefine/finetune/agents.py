"""A checkpoint of ``vt_dp3`` as what DPPO tunes: pre-trained, or tuned by an earlier run."""

from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser

from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.protocols import Agent
from lerobot_vtrefine.lerobot_compat.local_places import damaged_settings
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy

CHAIN = {
    "sampler": "sampler",
    "sampler_steps": "num_inference_steps",
    "prefix_steps": "prefix_steps",
    "ft_denoising_steps": "ft_denoising_steps",
}
"""Settings of ``dppo`` that say which denoising steps are tuned, and a policy's own names for them."""


def load_policy(path: Path, overrides: list[str] | None = None) -> VtDp3Policy:
    """Load a ``vt_dp3`` checkpoint with these flags, by default the command line's ``--policy.*``.

    Raises: ValueError for a checkpoint of another policy type, FileNotFoundError where there is none.
    """
    if overrides is None:
        overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
    if problem := damaged_settings(path):
        raise ValueError(problem)
    try:
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
    except (OSError, ValueError) as error:  # what the Hub says of a folder that is not there is no help
        if path.is_dir():
            raise
        raise FileNotFoundError(
            f"no checkpoint at --policy.path={path}: neither a folder (.../pretrained_model) nor a model on"
            " the Hub"
        ) from error
    if not isinstance(config, VtDp3Config):
        raise ValueError(f"{path} holds a policy of type {config.type}; vtrefine-finetune needs vt_dp3")
    if config.use_peft:
        raise ValueError(f"{path} holds adapters (--peft.*) only; vtrefine-finetune needs all weights")
    return VtDp3Policy.from_pretrained(path, config=config)


def make_agent(policy: VtDp3Policy, dppo: DppoConfig) -> Agent:
    """The tuned and the frozen network of a policy, and the sampler of rollouts and deployment.

    A pre-trained policy is made ready for DPPO first; a checkpoint of a DPPO run is so already.
    """
    if not policy.config.ft_denoising_steps:
        chain = {own: getattr(dppo, name) for name, own in CHAIN.items()}
        policy.prepare_finetuning(**chain, eta=dppo.deploy_eta, freeze_encoder=dppo.encoder == "frozen")
    policy.eval()
    config = policy.config
    if policy.base is None:
        raise ValueError("the policy has no frozen base network")
    return Agent(
        actor=policy.model,
        base=policy.base,
        process=policy.process,
        num_tuned=config.ft_denoising_steps,
        action_shape=(config.horizon, config.action_dim),
        executed=slice(0, config.n_action_steps),
        frozen_encoder=config.ft_freeze_encoder,
        deploy_eta=config.ft_eta,
        deploy_correlation=config.ft_noise_correlation,
    )


def check_same_chain(dppo: DppoConfig, policy: VtDp3Config) -> None:
    """Raises: ValueError where a new run would tune other denoising steps than the policy's networks do."""
    kept = {name: getattr(policy, own) for name, own in CHAIN.items()}
    kept["encoder"] = "frozen" if policy.ft_freeze_encoder else "trained"
    if given := [f"--dppo.{name}={value}" for name, value in kept.items() if getattr(dppo, name) != value]:
        raise ValueError(
            f"--policy.path is fine-tuned already: go on with its networks by {' '.join(given)}, or start"
            " from the pre-trained checkpoint"
        )
