"""LeRobot's policy server for policies that read pads: asynchronous inference with ``vt_dp3``.

LeRobot 0.6.1's server knows a list of policies, hands them joints and colour images only, takes observations
less than 1 rad apart for the same, and knows no policy that reads several frames. Its client needs nothing:
it finds plug-ins, and pads travel as any other array.
"""

from collections.abc import Mapping
from concurrent import futures
from typing import Any

import grpc
import torch
from lerobot.async_inference import policy_server
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.constants import SUPPORTED_POLICIES
from lerobot.async_inference.helpers import TimedAction, TimedObservation
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.transport import services_pb2_grpc
from lerobot.utils.constants import OBS_STR

from lerobot_vtrefine.lerobot_compat import arrays
from lerobot_vtrefine.lerobot_compat.action_rates import RATE
from lerobot_vtrefine.lerobot_compat.checkpoint_guard import POLICY
from lerobot_vtrefine.lerobot_compat.guard import is_supported

WORKERS = 4
REMEMBERED = 16
"""Observations that are kept for policies that read several frames."""


class PadPolicyServer(policy_server.PolicyServer):
    """LeRobot's server, whose ``vt_dp3`` sees what it would see under ``lerobot-rollout``; others are served
    as ever.
    """

    # Set by the client's first message.
    policy: Any
    preprocessor: Any
    postprocessor: Any
    lerobot_features: Any
    device: Any

    def SendPolicyInstructions(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802
        """As LeRobot's; the client is told in one line of no such policy, and of one of another rate."""
        try:
            answer = super().SendPolicyInstructions(request, context)
            fps = dict(context.invocation_metadata()).get(RATE)
            if fps is not None and hasattr(self.policy.config, "check_fps"):
                self.policy.config.check_fps(float(fps), "--fps")
        except (ValueError, OSError, ImportError) as error:
            context.abort(
                grpc.StatusCode.FAILED_PRECONDITION, f"policy server: {' '.join(str(error).split())}"
            )
        return answer

    def _reset_server(self) -> None:
        super()._reset_server()
        self._seen: dict[int, TimedObservation] = {}

    def _enqueue_observation(self, obs: TimedObservation) -> bool:
        seen = {**self._seen, obs.get_timestep(): obs}
        self._seen = dict(sorted(seen.items())[-REMEMBERED:])
        return super()._enqueue_observation(obs)

    def _obs_sanity_checks(self, obs: TimedObservation, previous_obs: TimedObservation) -> bool:
        """Whether to plan from an observation: LeRobot's threshold of 1 is for degrees, these are radians."""
        if self.policy_type != POLICY:
            return super()._obs_sanity_checks(obs, previous_obs)
        with self._predicted_timesteps_lock:
            return obs.get_timestep() not in self._predicted_timesteps

    def _predict_action_chunk(self, observation_t: TimedObservation) -> list[TimedAction]:
        """Actions (at most ``actions_per_chunk``) from an observation and those of the steps before it."""
        if self.policy_type != POLICY:
            return super()._predict_action_chunk(observation_t)
        step = observation_t.get_timestep()
        told = window({**self._seen, step: observation_t}, step, self.policy.config.n_obs_steps)
        with torch.inference_mode():
            frames = [self._processed(observation.get_observation()) for observation in told]
            tensors = [key for key, value in frames[0].items() if isinstance(value, torch.Tensor)]
            chunk = self._get_action_chunk({key: torch.stack([f[key] for f in frames], 1) for key in tensors})
            actions = torch.stack([self.postprocessor(action)[0].cpu() for action in chunk.unbind(1)])
        self.last_processed_obs = observation_t
        # An observation bears the number of the action before it, so that the plan begins with the next one;
        # LeRobot begins with the one that was executed.
        return self._time_action_chunk(observation_t.get_timestamp(), list(actions), step + (step > 0))

    def _processed(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """One frame (1, ...) as the policy reads it."""
        frame = policy_server_frame(self.lerobot_features, observation)
        task = str(observation.get("task", ""))
        return self.preprocessor(prepare_observation_for_inference(frame, torch.device(self.device), task))


def policy_server_frame(features: dict[str, dict], observation: Mapping[str, Any]) -> dict[str, Any]:
    """A robot's observation as a dataset's frame, arrays included."""
    from lerobot.utils.feature_utils import build_dataset_frame  # here, when `arrays` is installed

    return build_dataset_frame(features, dict(observation), prefix=OBS_STR)


def window[T](seen: Mapping[int, T], step: int, length: int) -> list[T]:
    """What was seen at the last ``length`` steps up to ``step``; where nothing was sent, the next."""
    found = [seen[step]]
    for earlier in range(step - 1, step - length, -1):
        found.insert(0, seen.get(earlier, found[0]))
    return found


def start(host: str, port: int, fps: int) -> grpc.Server:
    """A running server; stop it with ``stop`` or wait for its end.

    Args:
        fps: actions per second, by which their times are told.

    Raises:
        RuntimeError: a LeRobot version whose server was not tested with this.
        ValueError: the address is taken, or none of this machine's.
    """
    if not is_supported():
        raise RuntimeError("vtrefine-policy-server needs lerobot >=0.6.1,<0.7: it extends its server")
    arrays.install()
    if POLICY not in SUPPORTED_POLICIES:
        SUPPORTED_POLICIES.append(POLICY)
    service = PadPolicyServer(PolicyServerConfig(host=host, port=port, fps=fps))
    options = [("grpc.so_reuseport", 0)]  # or a second server shares the port, and gets half of the calls
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=WORKERS), options=options)
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(service, server)
    try:
        server.add_insecure_port(f"{host}:{port}")
    except RuntimeError as error:
        raise ValueError(
            f"cannot listen at {host}:{port}: choose another --port, if a server is there, or another --host"
        ) from error
    server.start()
    return server
