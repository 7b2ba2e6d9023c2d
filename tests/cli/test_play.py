"""``vtrefine-play`` without a viewer, with one, and in a real browser."""

import json
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from lerobot_vtrefine.cli.play import EpisodeSource, PlayConfig, PolicySource, play, with_something_to_play
from lerobot_vtrefine.cli.playing.agents import ExpertAgent, ZeroAgent
from lerobot_vtrefine.cli.playing.session import Session
from lerobot_vtrefine.cli.record_demos import RecordDemosConfig, record
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.episode_log import read_episode_log
from lerobot_vtrefine.envs.live_world import LiveWorld
from lerobot_vtrefine.shipped import policies

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
ENV = VtRefineEnvConfig(start="grasped", num_threads=1, episode_steps=48)


def played(**settings: object) -> list[dict]:
    return play(PlayConfig(**({"env": ENV, "viewer": "none"} | settings)))


def test_the_expert_succeeds_and_holding_still_does_not(capsys: pytest.CaptureFixture[str]) -> None:
    assert [row["success"] for row in played(episodes=2, seed=3)] == [True, True]
    assert "2 of 2 succeeded" in capsys.readouterr().out
    short = VtRefineEnvConfig(start="grasped", num_threads=1, episode_steps=5)
    assert played(agent="zero", env=short)[0]["failure"] == "time_out"
    assert not played(agent="random", env=short)[0]["success"]


def test_what_is_played_is_logged(tmp_path: Path) -> None:
    log = tmp_path / "episodes.jsonl"
    rows = played(episodes=2, agent="zero", env=replace(ENV, episode_steps=3, metrics_path=log))
    assert read_episode_log(log, 0, 2) == rows
    assert [row["failure"] for row in rows] == ["time_out", "time_out"]


def test_a_recorded_episode_plays_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = tmp_path / "demos"
    record(RecordDemosConfig(root, num_episodes=1, num_envs=1, seed=4, env=ENV))
    noted = json.loads((root / "meta" / "recording.json").read_text())["episodes"][0]
    (row,) = played(dataset=EpisodeSource(root, 0), env=None)
    assert (row["seed"], row["steps"], row["success"]) == (noted["seed"], noted["steps"], True)
    assert row["depth_m"] == noted["depth_m"]
    with pytest.raises(ValueError, match=r"demos has 10 frames/s, the twin --env\.fps=20; give the same"):
        played(dataset=EpisodeSource(root, 0), env=replace(ENV, fps=20))
    assert "the twin has" not in caplog.text
    played(dataset=EpisodeSource(root, 0), env=replace(ENV, pair="key", episode_steps=3))
    assert (
        "the twin has --env.pair=key; for the task that was recorded add --env.pair=round" in caplog.messages
    )


@pytest.mark.slow
def test_episodes_are_filmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = VtRefineEnvConfig(start="grasped", num_threads=1, episode_steps=5)
    played(env=short, agent="zero", seed=4, record=True, video_dir=tmp_path / "videos")
    assert (tmp_path / "videos" / "seed_4.mp4").stat().st_size > 1000
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"videos of every episode go to {tmp_path / 'videos'}"
    assert "seed_4.mp4" in told[2]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"agent": "expret"}, "--agent=expret is unknown; choose from expert, zero, random"),
        ({"policy": PolicySource("configs")}, "--policy.path=configs holds no checkpoint"),
        ({"port": 99999}, "--port must lie between 1 and 65535, got 99999"),
        ({"viewer": "window"}, "--viewer=window is unknown"),
        ({"dataset": EpisodeSource(Path("nowhere"))}, "nowhere holds no LeRobot dataset"),
        ({"video_dir": Path("README.md")}, "--video_dir=README.md is a file; name a folder"),
        ({"video_dir": Path("/proc/films")}, "No such file or directory: '--video_dir=/proc/films'"),
    ],
)
def test_wrong_flags_are_one_line(settings: dict, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises((ValueError, OSError), match=re.escape(words)):
        played(**settings)


def test_the_shipped_policy_plays_at_the_rate_it_learned_alone() -> None:
    (path,) = policies().values()
    with pytest.raises(ValueError, match=r"--env\.fps=20, but the policy learned 10 actions a second"):
        played(policy=PolicySource(str(path)), env=VtRefineEnvConfig(start="grasped", fps=20))


def test_looks_alone_do_not_choose_what_is_played() -> None:
    looks = "--env.menagerie_dir=there"
    assert with_something_to_play([looks]) == [*with_something_to_play([]), looks]
    assert with_something_to_play(["--env.pair=key"]) == ["--env.pair=key"]


def test_an_untrained_policy_plays(tmp_path: Path) -> None:
    from lerobot.envs.utils import env_to_policy_features

    from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
    from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
    from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import make_vt_dp3_pre_post_processors

    features = env_to_policy_features(ENV)
    config = VtDp3Config(preset="small", point_dims=(8, 16), down_dims=(32, 32), device="cpu")
    config.input_features = {key: value for key, value in features.items() if key != "action"}
    config.output_features = {"action": features["action"]}
    VtDp3Policy(config).save_pretrained(tmp_path)
    stats = {key: {"min": -np.ones(16), "max": np.ones(16)} for key in ("observation.state", "action")}
    for pipeline in make_vt_dp3_pre_post_processors(config, stats):
        pipeline.save_pretrained(tmp_path)
    short = VtRefineEnvConfig(start="grasped", num_threads=1, episode_steps=4)
    first, again = (played(policy=PolicySource(str(tmp_path), "cpu"), env=short) for _ in range(2))
    assert first == again


class Person:
    """Somebody at the page: does the next thing at every look."""

    def __init__(self, *things: dict) -> None:
        from lerobot_vtrefine.view.browser import Wishes

        self.wishes, self.things, self.seen = Wishes(), iter(things), []

    def update(self, now: bool = False) -> None:
        self.seen.append(now)
        for name, value in next(self.things, {}).items():
            setattr(self.wishes, name, value)


def test_pause_step_and_reset(tmp_path: Path) -> None:
    world = LiveWorld(VtRefineEnvConfig(start="grasped", num_threads=1, episode_steps=3, fps=40))
    person = Person({"paused": True}, {"step": True}, {}, {"reset": True, "paused": False, "seed": 9})
    told: list[str] = []
    Session(world, ZeroAgent(), person, tmp_path, told.append).play(0, 1, record=False)
    assert told == ["seed 9: time out after 3 steps (0 of 1 succeeded)"]
    assert person.seen[-1]


class LateWorld(LiveWorld):
    """Its episodes start where much of the time is over, as those of a bank do."""

    def reset(self, seed: int) -> None:
        super().reset(seed)
        self.sim.steps[:] = 40


def test_what_a_bank_leaves_out_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    world = LateWorld(VtRefineEnvConfig(start="grasped", num_threads=1, episode_steps=43, fps=40))
    Session(world, ZeroAgent(), Person(), tmp_path, print).play(0, 1, record=False)
    assert world.steps == 43
    assert max(slept[:-1]) <= 3 / 40  # the last one shows the end


def test_the_page_shows_what_is_there_and_looking_changes_nothing() -> None:
    from lerobot_vtrefine.view.browser import BrowserView

    def run(watched: bool) -> np.ndarray:
        world = LiveWorld(ENV)
        world.reset(0)
        view = BrowserView(world, 8231) if watched else None
        agent = ExpertAgent()
        agent.reset(world)
        for _ in range(5):
            world.step(agent.act(world))
            world.observe()
            if view is not None:
                view.update(now=True)
        if view is not None:
            assert b"<html" in urlopen(f"http://127.0.0.1:{view.port}", timeout=10).read().lower()
            assert f"seed 0 · {world.time_s:.1f} s" in view._status.content
            assert view._pads.image.std() > 1  # the parts are in hand
            view.close()
        return world.raw["tactile"]

    np.testing.assert_array_equal(run(True), run(False))


@pytest.mark.slow
def test_in_a_real_browser(tmp_path: Path) -> None:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)}")
    sync_api = pytest.importorskip("playwright.sync_api")
    command = [sys.executable, "-m", "lerobot_vtrefine.cli.play", "--env.type=vtrefine", "--port=8232"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            lines = (re.search(r"http://localhost:\d+", line) for line in process.stdout)
            address = next(found for found in lines if found is not None)
            with sync_api.sync_playwright() as started:
                flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
                shown = started.chromium.launch(executable_path=browser, args=flags)
                page = shown.new_page()
                page.goto(address.group())
                page.wait_for_selector("text=plug on socket", timeout=60_000)
                page.get_by_role("checkbox").first.check(force=True)
                time.sleep(2)
                frozen = page.inner_text("body")
                time.sleep(1)
                assert page.inner_text("body") == frozen
                page.screenshot(path=tmp_path / "page.png")
                shown.close()
        finally:
            process.terminate()
    assert (tmp_path / "page.png").stat().st_size > 10_000
