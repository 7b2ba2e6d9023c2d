"""Video frames of single environments, drawn on first use, and those that make ``lerobot-eval``'s videos."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, overload

import gymnasium as gym
import numpy as np

from lerobot_vtrefine.envs.episodes import Array, Episodes

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.render import VideoRenderer


class FrameSource:
    """Draws the environments of ``episodes``; a frame is drawn again only after its environment moved."""

    def __init__(self, episodes: Episodes, menagerie_dir: Path | None) -> None:
        self._episodes, self._menagerie_dir = episodes, menagerie_dir
        self._renderers: dict[int, VideoRenderer] = {}
        self._drawn: dict[int, tuple[tuple[int, int], Array]] = {}

    def frame(self, index: int) -> Array:
        """uint8 (H, W, 3) frame of environment ``index``."""
        moment = (int(self._episodes.seeds[index]), int(self._episodes.steps[index]))
        if self._drawn.get(index, (None,))[0] != moment:
            self._drawn[index] = (moment, self._renderer(index).frame())
        return self._drawn[index][1]

    def close(self) -> None:
        """Free the rendering contexts."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers, self._drawn = {}, {}

    def _renderer(self, index: int) -> "VideoRenderer":
        if index not in self._renderers:
            from lerobot_vtrefine.sim.render import VideoRenderer

            self._renderers[index] = VideoRenderer(
                self._episodes.sim, index, menagerie_dir=self._menagerie_dir
            )
        return self._renderers[index]


class EvalFrame(np.ndarray):
    """A frame for ``lerobot-eval``, which says itself how ``np.stack`` joins it with others.

    LeRobot asks for ten videos, whatever they cost. It stacks the frames of all environments at the reset and
    after every step, then these moments along axis 1, and keeps the first moments of each episode, as many as
    it has steps: the last one, which shows how the episode ended, would be cut off. Therefore

    - frames without pixels leave themselves out, so that no video is made of them;
    - the frame of the reset makes room for the last one.
    """

    def __array_function__(
        self, func: Callable[..., Any], types: Iterable[type], args: Iterable[Any], kwargs: Mapping[str, Any]
    ) -> Any:
        """NumPy's protocol: ``np.stack`` as described above, everything else as for any array."""
        if func is np.stack:
            return _stack(*args, **kwargs)
        return super().__array_function__(func, types, args, kwargs)


def _stack(arrays: Sequence[Array], axis: int = 0) -> Array:
    plain = [np.asarray(array) for array in arrays]
    if axis == 1:  # moments (k, H, W, 3) -> (k, T, H, W, 3)
        return np.stack(plain[1:], axis=1)
    drawn = [frame for frame in plain if frame.size]
    return (np.stack(drawn) if drawn else np.zeros((0, 0, 0, 3), np.uint8)).view(EvalFrame)


def eval_frame(draw: Callable[[], Array], wanted: bool) -> EvalFrame:
    """What ``draw`` draws where it is wanted, else a frame without pixels."""
    return (draw() if wanted else np.zeros((0, 0, 3), np.uint8)).view(EvalFrame)


class EvalVideos(gym.Wrapper):
    """A single environment for ``lerobot-eval``: ``render`` draws the first ``video_episodes`` episodes.

    These are counted over all ``total`` environments that play together; this one is number ``position``.
    """

    def __init__(self, env: gym.Env, video_episodes: int, position: int, total: int) -> None:
        super().__init__(env)
        self._videos, self._total = video_episodes, total
        self._episode = position - total

    def reset(self, **settings: Any) -> tuple[Any, dict[str, Any]]:
        """Start the next episode."""
        self._episode += self._total
        return self.env.reset(**settings)

    def render(self) -> EvalFrame:
        """The environment's frame, for LeRobot."""
        return eval_frame(lambda: np.asarray(self.env.render()), self._episode < self._videos)


class LazyFrames(Sequence[Array]):
    """Frames rendered when indexed: ``lerobot-eval`` asks for all environments and keeps the first few."""

    def __init__(self, render: Callable[[int], Array], count: int) -> None:
        self._render = render
        self._indices = range(count)

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Array: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Array, ...]: ...
    def __getitem__(self, index: SupportsIndex | slice) -> Array | tuple[Array, ...]:
        if isinstance(index, slice):
            return tuple(self._render(i) for i in self._indices[index])
        return self._render(self._indices[index])
