"""``vtrefine-finetune`` on a tiny policy without a simulator: files, exact resumption, bad input."""

import json
import pickle
import re
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.common.train_utils import update_last_checkpoint
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file
from tiny_policy import ReachEnv, save_tiny_checkpoint

from lerobot_vtrefine.cli import finetune as command
from lerobot_vtrefine.cli.finetune import main
from lerobot_vtrefine.cli.results.collect import run_rows
from lerobot_vtrefine.cli.results.provenance import commit, machine
from lerobot_vtrefine.envs.decisions import make_decision_env
from lerobot_vtrefine.finetune import pipeline
from lerobot_vtrefine.finetune.config import PaperDppo
from lerobot_vtrefine.finetune.logger import CLOCK, read_progress
from lerobot_vtrefine.finetune.noise import policy_noise
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS
from lerobot_vtrefine.finetune.state_file import load_state
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy

SMALL = [
    "--env.type=vtrefine",
    "--eval.n_episodes=8",
    "--eval_freq=2",
    "--save_freq=1",
    "--dppo.type=small",
    "--dppo.num_envs=6",
    "--dppo.epochs=2",
    "--dppo.minibatch_decisions=6",
    "--dppo.critic_width=16",
    "--dppo.critic_warmup=1",
]


@pytest.fixture
def finetune(tmp_path, monkeypatch):
    """Runs the command with a checkpoint to start from; returns its exit status."""
    start = save_tiny_checkpoint(tmp_path / "start")
    monkeypatch.setattr(pipeline, "make_decision_env", lambda env, num_envs, *rest: ReachEnv(num_envs))

    def run(output_dir: Path, *arguments: str, policy: Path = start, iterations: int = 4) -> int:
        named = [f"--policy.path={policy}", f"--output_dir={output_dir}", f"--dppo.iterations={iterations}"]
        monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *named, *SMALL, *arguments])
        return main()

    return run


def tensors(output_dir: Path, step: str) -> dict[str, torch.Tensor]:
    return load_file(output_dir / "checkpoints" / step / "pretrained_model" / "model.safetensors")


@pytest.mark.parametrize("encoder", ["frozen", "trained"])
def test_resumed_run_equals_the_uninterrupted_one(finetune, tmp_path, encoder):
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    changes = (
        f"--dppo.encoder={encoder}",
        "--dppo.reward_scaling=true",
        "--dppo.kl_coef=0.1",
        "--dppo.bc_coef=0.1",
    )
    assert finetune(whole, *changes) == 0
    shutil.copytree(whole, resumed, symlinks=True)
    for later in ("000003", "000004"):  # as if it had been interrupted after the second iteration
        shutil.rmtree(resumed / "checkpoints" / later)
    update_last_checkpoint(resumed / "checkpoints" / "000002")
    assert finetune(resumed, "--resume=true", *changes) == 0

    expected, found = tensors(whole, "000004"), tensors(resumed, "000004")
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[key], found[key]) for key in expected)
    assert not all(torch.equal(expected[key], value) for key, value in tensors(whole, "000002").items())
    state = [
        load_state(run / "checkpoints" / "000004" / "training_state" / "dppo_state.safetensors")
        for run in (whole, resumed)
    ]
    torch.testing.assert_close(*state, rtol=0, atol=0)
    rows = [
        [{key: value for key, value in row.items() if key not in CLOCK} for row in read_progress(run)]
        for run in (whole, resumed)
    ]
    assert rows[0] == rows[1]


def test_records_and_checkpoint(finetune, tmp_path, capsys):
    output = tmp_path / "run"
    assert finetune(output, iterations=2) == 0
    rows = read_progress(output)
    counts = [f"({round(12 * row['eval_success'])} of 12 episodes)" for row in (rows[0], rows[-1])]
    said = capsys.readouterr().out
    assert re.search(
        rf"DPPO .*: success went from .*{re.escape(counts[0])} to .*{re.escape(counts[1])}", said
    )
    assert [row["iteration"] for row in rows] == [0, 1, 2]
    assert {"success", "return", "approx_kl", "clip_fraction", "explained_variance", "steps_per_s"} <= rows[
        1
    ].keys()
    assert {"eval_success", "eval_return", "eval_error"} <= rows[2].keys()
    assert "eval_success" not in rows[1]
    assert (output / "curves.png").stat().st_size > 10_000

    path = output / "checkpoints" / "last" / "pretrained_model"
    policy = VtDp3Policy.from_pretrained(path, config=PreTrainedConfig.from_pretrained(path)).eval()
    assert policy.config.ft_denoising_steps == 10
    assert policy.config.sampler == "tail"
    assert policy.config.ft_eta == 1.0
    assert (path / "policy_preprocessor.json").is_file()
    assert (path / "policy_postprocessor.json").is_file()


def test_a_run_becomes_a_row_of_the_results(finetune, tmp_path):
    output, common = tmp_path / "run", {"table": "converges", "task": "reach"}
    assert finetune(output, "--seed=30000000", iterations=3) == 0
    *earlier, (row, progress) = run_rows(output, common, dict.fromkeys(("commit", "command", "machine")))
    logged = read_progress(output)
    told = [(row.variant, row.iterations, row.success, row.env_steps) for row, _ in earlier]
    assert told == [
        (variant, at, logged[at]["eval_success"], logged[at].get("env_steps", 0))
        for variant, at in (("imitation", 0), ("half-way", 2))
    ]
    assert progress == logged
    assert (row.task, row.policy, row.seed) == ("reach", "visuo_tactile", 30_000_000)
    assert (row.success, row.episodes) == (logged[-1]["eval_success"], 12)  # 8 in two batches of 6
    assert (row.iterations, row.env_steps) == (3, logged[-1]["env_steps"])
    assert row.extra["seconds"] == pytest.approx(sum(line.get("seconds", 0) for line in logged), abs=0.06)
    assert row.commit == commit()
    assert row.command.startswith("vtrefine-finetune --policy.path=.../start --output_dir=.../run")
    assert row.machine == machine()

    shutil.rmtree(output / "checkpoints")  # as copied from another machine
    with pytest.raises(ValueError, match="holds no checkpoint that tells the policy; add --policy="):
        run_rows(output, common, {})
    (output / "progress.csv").write_text("\n".join((output / "progress.csv").read_text().splitlines()[:3]))
    with pytest.raises(ValueError, match="run has 1 of 3 iterations; finish it with --resume=true"):
        run_rows(output, common, {})


def test_every_evaluation_has_its_own_number_of_episodes(finetune, tmp_path, capsys):
    """It had been that of the last command for all, and an earlier evaluation had stood for the last."""
    output, common = tmp_path / "run", {"table": "converges", "task": "reach"}
    assert finetune(output, iterations=2) == 0
    capsys.readouterr()
    assert finetune(output, "--resume=true", "--eval.n_episodes=20", iterations=3) == 0
    assert re.search(r"from .* of 12 episodes\) to .* of 24 episodes\)", capsys.readouterr().out)
    found = [(row.variant, row.episodes) for row, _ in run_rows(output, common, {})]
    assert found == [("imitation", 12), ("half-way", 12), ("", 24)]
    assert finetune(output, "--resume=true", "--eval_freq=0", iterations=4) == 0
    assert "success was not measured before and after" in capsys.readouterr().out


@pytest.mark.parametrize(("eta", "correlation"), [(0.0, 0.0), (1.0, 0.0), (1.0, 0.8)])
def test_reloaded_checkpoint_deploys_what_was_evaluated(finetune, tmp_path, eta, correlation):
    """The last evaluation of the run is repeated by the policy's own inference from the files."""
    output = tmp_path / "run"
    flags = (f"--dppo.eta={eta}", f"--policy.ft_noise_correlation={correlation}")
    assert finetune(output, "--dppo.encoder=trained", *flags, iterations=2) == 0
    path = output / "checkpoints" / "last" / "pretrained_model"
    policy = VtDp3Policy.from_pretrained(path, config=PreTrainedConfig.from_pretrained(path)).eval()
    assert (policy.config.ft_eta, policy.config.ft_noise_correlation) == (eta, correlation)
    env, first = ReachEnv(6), EVALUATION_SEEDS
    success = []
    for batch in range(2):
        seed = first + 6 * batch
        torch.manual_seed(seed)
        obs, _ = env.reset(range(seed, seed + 6))
        running, reached = torch.ones(6, dtype=torch.bool), torch.zeros(6, dtype=torch.bool)
        generator = policy_noise(torch.device("cpu"), seed)
        while running.any():
            noise = torch.randn(int(running.sum()), 8, 16, generator=generator)
            actions = torch.zeros(6, 4, 16)
            frames = {key: value[running] for key, value in obs.items()}
            actions[running] = policy.sample_actions(frames, noise, generator)[:, :4]
            obs, _, reward, terminated, truncated, _ = env.step_chunk(actions)
            reached |= reward > 0
            running &= ~terminated & ~truncated
        success.append(reached)
    assert read_progress(output)[-1]["eval_success"] == pytest.approx(
        float(torch.cat(success).float().mean())
    )


def test_an_existing_run_is_not_overwritten(finetune, tmp_path, capsys):
    output = tmp_path / "run"
    assert finetune(output, iterations=1) == 0
    assert finetune(output, iterations=1) == 2
    assert "--resume=true" in capsys.readouterr().err


@pytest.mark.parametrize("resume", ["false", "true"])
def test_checkpoints_of_another_command_keep_their_place(finetune, tmp_path, capsys, resume):
    policy = save_tiny_checkpoint(tmp_path / "run" / "checkpoints" / "000001" / "pretrained_model")
    before = {path: path.read_bytes() for path in policy.iterdir()}
    assert finetune(tmp_path / "run", f"--resume={resume}", policy=policy, iterations=1) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "000001 is another command's checkpoint" in error
    assert "choose another --output_dir" in error
    assert {path: path.read_bytes() for path in policy.iterdir()} == before


def test_settings_are_saved_and_can_be_read_again(finetune, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert finetune(first, "--env.clearance_m=0.001", iterations=1) == 0
    assert finetune(second, f"--config_path={first / 'finetune_config.json'}", iterations=1) == 0
    saved = [json.loads((run / "finetune_config.json").read_text()) for run in (first, second)]
    assert saved[1].pop("output_dir") == str(second)
    assert saved[0].pop("output_dir") == str(first)
    assert saved[0] == saved[1]
    assert saved[1]["env"]["clearance_m"] == 0.001
    assert saved[1]["dppo"]["epochs"] == 2


def test_checkpoints_hold_the_settings_of_their_run(finetune, tmp_path, monkeypatch):
    """As those of ``lerobot-train`` do; ``--config_path`` takes the file, or the folder, and continues."""
    output, again = tmp_path / "run", tmp_path / "again"
    assert finetune(output, "--env.clearance_m=0.001", iterations=2) == 0
    settings = output / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    saved = json.loads(settings.read_text())
    assert saved == json.loads((output / "finetune_config.json").read_text())
    policy = json.loads((settings.parent / "config.json").read_text())
    assert saved["policy"] == policy | {"pretrained_path": str(tmp_path / "start")}
    assert (saved["env"]["clearance_m"], saved["dppo"]["epochs"]) == (0.001, 2)
    loaded = pipeline.FinetunePipelineConfig.from_pretrained(settings.parent)
    assert (loaded.dppo.num_envs, loaded.start) == (6, tmp_path / "start")

    def command(*arguments: str) -> int:
        monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *arguments])
        return main()

    assert command(f"--config_path={settings}", "--resume=true", "--dppo.iterations=3") == 0
    assert [row["iteration"] for row in read_progress(output)] == [0, 1, 2, 3]
    assert (output / "checkpoints" / "last").resolve().name == "000003"
    assert command(f"--config_path={settings.parent}", f"--output_dir={again}", "--dppo.iterations=2") == 0
    first, second = tensors(output, "000002"), tensors(again, "000002")
    assert all(torch.equal(first[key], second[key]) for key in first)


@pytest.mark.parametrize(
    ("flag", "words"),
    [
        ("--dppo.sampler=ddim", "was made with --dppo.sampler=tail, not ddim"),
        ("--dppo.ft_denoising_steps=5", "was made with --dppo.ft_denoising_steps=10, not 5"),
        ("--dppo.encoder=frozen", "was made with --dppo.encoder=trained, not frozen"),
        ("--dppo.critic_width=8", "was made with --dppo.critic_width=16, not 8"),
        ("--dppo.num_envs=3", "was made with --dppo.num_envs=6, not 3"),  # episodes would come twice
        ("--seed=3", "was made with --seed=0, not 3"),
    ],
)
def test_what_a_checkpoint_was_made_with_stays_when_it_is_resumed(finetune, tmp_path, capsys, flag, words):
    """It was not taken up, and noted as if it had been; or ended in a traceback."""
    output = tmp_path / "run"
    assert finetune(output, iterations=1) == 0
    noted = (output / "finetune_config.json").read_text()
    assert finetune(output, "--resume=true", flag, iterations=2) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert words in error
    assert "000001" in error
    assert (output / "finetune_config.json").read_text() == noted


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reward": torch.full((6,), torch.nan)}, "loss is not finite in iteration 0: lower --dppo.actor_lr"),
        ({"info": {"void": torch.ones(6, dtype=torch.bool)}}, "the simulation failed in every episode"),
    ],
)
def test_an_iteration_that_nothing_can_be_learnt_from_is_one_line(
    finetune, tmp_path, capsys, monkeypatch, change, words
):
    step = ReachEnv.step_chunk

    def broken(env, actions):
        made = step(env, actions)
        return made._replace(**change | {"info": made.info | change.get("info", {})})

    monkeypatch.setattr(ReachEnv, "step_chunk", broken)
    assert finetune(tmp_path / "run", "--eval_freq=0", iterations=1) == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]


def test_a_finished_run_resumes_to_nothing(finetune, tmp_path):
    output = tmp_path / "run"
    assert finetune(output, iterations=1) == 0
    before = (output / "progress.csv").read_text()
    assert finetune(output, "--resume=true", iterations=1) == 0
    assert (output / "progress.csv").read_text() == before


def test_a_tuned_policy_may_practise_on_elsewhere_with_a_critic_of_its_own(finetune, tmp_path, capsys):
    assert finetune(tmp_path / "home", iterations=2) == 0
    tuned = tmp_path / "home" / "checkpoints" / "last" / "pretrained_model"
    before = tensors(tmp_path / "home", "last")
    assert finetune(tmp_path / "away", "--seed=5", policy=tuned, iterations=2) == 0
    after = tensors(tmp_path / "away", "last")
    kept = {name for name in before if torch.equal(before[name], after[name])}
    assert kept >= {name for name in before if name.startswith("base.")} > set()
    assert {name for name in before if name.startswith("model.denoiser.")} - kept
    assert [row["iteration"] for row in read_progress(tmp_path / "away")][-1] == 2
    capsys.readouterr()
    other = ["--dppo.sampler=ddim", "--dppo.sampler_steps=7", "--dppo.ft_denoising_steps=7"]
    assert finetune(tmp_path / "other", *other, policy=tuned) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert "--dppo.sampler=tail --dppo.sampler_steps=10" in told
    assert "pre-trained checkpoint" in told


def test_bad_input_is_one_clear_line(finetune, tmp_path, capsys):
    def complaint(*arguments: str, **options) -> str:
        assert finetune(tmp_path / "bad", *arguments, **options) == 2
        return capsys.readouterr().err.strip().splitlines()[-1]

    assert "--dppo.num_envs must be positive" in complaint("--dppo.num_envs=0")
    assert "within" in complaint("--dppo.sampler_steps=5", "--dppo.ft_denoising_steps=40")
    assert "--seed must not be negative, got -1" in complaint("--seed=-1")
    assert "--eval_freq=0 evaluates nothing" in complaint("--eval.n_episodes=0")
    assert "ddpm, ddim, tail" in complaint("--dppo.sampler=euler")
    missing = tmp_path / "nowhere"
    assert f"no checkpoint at --policy.path={missing}" in complaint(policy=missing)
    damaged = save_tiny_checkpoint(tmp_path / "damaged")
    (damaged / "config.json").write_text("{")
    assert f"{damaged}: config.json is not valid JSON" in complaint(policy=damaged)
    (damaged / "config.json").write_text("[]")
    assert f"{damaged}: config.json does not hold settings by name" in complaint(policy=damaged)
    folder = save_tiny_checkpoint(tmp_path / "folder")
    (folder / "model.safetensors").unlink()
    (folder / "model.safetensors").mkdir()
    assert f"{folder}/model.safetensors is a folder; copy the checkpoint again" in complaint(policy=folder)
    other = "--env.scene.embodiment=kinova"
    assert f"{other}, but the policy is of aloha: name an environment" in complaint(other)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env.pair=star"], "round, square, hexagon"),
        (["--env.clearance_m=0"], "clearance_m must be above 0"),
        (["--env.clearance_m=0.05"], "too large for the round plug"),
        (["--env.pair=automate/00186", "--env.mesh_dir=nowhere"], "nowhere"),
        (["--env.type=aloha"], "--env.type=vtrefine"),
    ],
)
def test_bad_tasks_are_one_clear_line(finetune, tmp_path, capsys, monkeypatch, flags, words):
    monkeypatch.setattr(pipeline, "make_decision_env", make_decision_env)
    assert finetune(tmp_path / "bad", *flags) == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]


def test_another_control_rate_than_the_policy_learned_is_refused(finetune, tmp_path, capsys):
    assert finetune(tmp_path / "bad", "--env.fps=20", "--policy.fps=10") == 2
    assert "the policy learned 10 actions a second: give --env.fps=10" in capsys.readouterr().err
    assert finetune(tmp_path / "good", "--env.fps=20", "--policy.fps=20", iterations=1) == 0
    assert finetune(tmp_path / "old", "--env.fps=20", iterations=1) == 0  # a checkpoint that does not say


def test_policy_of_another_type_is_refused(finetune, tmp_path, capsys):
    from lerobot.policies.act.configuration_act import ACTConfig

    other = tmp_path / "act"
    ACTConfig(device="cpu").save_pretrained(other)
    assert finetune(tmp_path / "run", policy=other) == 2
    assert "holds a policy of type act; vtrefine-finetune needs vt_dp3" in capsys.readouterr().err


def test_a_task_of_another_environment_is_refused_before_the_policy_is_loaded(tmp_path):
    task = tmp_path / "task.yaml"
    task.write_text("env: {type: pusht}")
    with pytest.raises(ValueError, match=r"needs --env\.type=vtrefine, got pusht"):
        pipeline.load_practice(tmp_path / "no policy", task, PaperDppo(), "cpu", ablate="touch")


def test_a_gpu_that_is_not_there_is_told_before_the_policy_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ValueError, match="--device=cuda: no CUDA GPU with a driver here"):
        pipeline.load_practice(tmp_path / "no policy", tmp_path / "no task", PaperDppo(), "cuda")


def test_a_task_practised_on_a_gpu_is_simulated_there(tmp_path):
    task = tmp_path / "task.yaml"
    task.write_text("env: {type: vtrefine, pair: square, backend: batch, scene: {timestep_s: 0.002}}")
    there, here = (pipeline.env_on(device, task) for device in ("cuda", "cpu"))
    assert (there.backend, there.warp.device) == ("warp", "cuda")
    assert here.backend == "batch"
    assert there.pair == here.pair == "square"
    own = pipeline.env_on("cuda", task, "batch", 0.005, start="grasped")
    assert (own.backend, own.scene.timestep_s, own.start) == ("batch", 0.005, "grasped")
    assert there.scene.timestep_s == 0.002


class Marking:
    """Unpickling it creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pickles_and_damaged_files_in_a_checkpoint_are_one_line(finetune, tmp_path, capsys):
    run, marker = tmp_path / "run", tmp_path / "ran"
    assert finetune(run, iterations=1) == 0
    last = run / "checkpoints" / "last"
    for file in (
        last / "training_state" / "dppo_state.safetensors",
        last / "pretrained_model" / "model.safetensors",
    ):
        sound = file.read_bytes()
        for damaged in (pickle.dumps(Marking(marker)), b"", sound[: len(sound) // 2]):
            file.write_bytes(damaged)
            assert finetune(run, "--resume=true", iterations=2) == 2
            assert "damaged" in capsys.readouterr().err.strip().splitlines()[-1]
        file.write_bytes(sound)
    assert not marker.exists()
    assert finetune(run, "--resume=true", iterations=2) == 0


@pytest.mark.parametrize(
    ("last", "told"),
    [
        (None, "no checkpoint yet, by --save_freq=10; the same command begins anew"),
        (Path("checkpoints/000010"), "the same command with --resume=true goes on from iteration 10"),
    ],
)
def test_an_interrupted_run_says_what_is_left_of_it(finetune, tmp_path, monkeypatch, capsys, last, told):
    def interrupted(cfg):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "run", interrupted)
    monkeypatch.setattr(command, "last_checkpoint", lambda folder: last)
    assert finetune(tmp_path / "run", "--save_freq=10") == 130
    assert capsys.readouterr().err.splitlines()[-1] == f"interrupted: {told}"
