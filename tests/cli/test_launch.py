"""Starting commands: names of configuration files, the umbrella, flags read from the source."""

import shlex
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from huggingface_hub.errors import LocalEntryNotFoundError, RepositoryNotFoundError

from lerobot_vtrefine import shipped
from lerobot_vtrefine.cli import launch, umbrella
from lerobot_vtrefine.cli.arguments import with_brackets
from lerobot_vtrefine.cli.checks import check_arguments
from lerobot_vtrefine.cli.flags import flags_of
from lerobot_vtrefine.cli.pipeline.demo_config import DemoConfig
from lerobot_vtrefine.lerobot_compat.local_places import refuse_missing_places

FINETUNE = ("lerobot_vtrefine.finetune.pipeline", "FinetunePipelineConfig")
RECORD = ("lerobot_vtrefine.cli.record_demos", "RecordDemosConfig")


def test_names_become_paths_wherever_a_path_may_stand() -> None:
    path = shipped.folder() / "env" / "round_grasped.yaml"
    assert path.is_file()
    assert shipped.expand(["--config_path=vtrefine:round_grasped", "--seed=3"]) == [
        f"--config_path={path}",
        "--seed=3",
    ]
    assert shipped.expand(["--config_path", "vtrefine:round_grasped"]) == ["--config_path", str(path)]
    others = ["--root=vtrefine:round_grasped", "--config_path=my.yaml", "vtrefine:round_grasped"]
    assert shipped.expand(others) == others


def test_an_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(
        ValueError, match=r"vtrefine:rund: no such configuration; choose from .*round_grasped"
    ):
        shipped.expand(["--config_path=vtrefine:rund"])
    with pytest.raises(ValueError, match=r"did you mean round_grasped\?$"):
        shipped.expand(["--config_path=vtrefine:round_grapsed"])


def test_a_name_without_its_prefix_is_recognised() -> None:
    flags = flags_of(*FINETUNE)
    for flag, name in (("--config_path", "round_grasped"), ("--policy.path", "square_grasped_1mm")):
        with pytest.raises(ValueError, match=f"no such file: .*; did you mean {flag}=vtrefine:{name}"):
            check_arguments(flags, [f"{flag}={name}"])


def test_names_are_unambiguous() -> None:
    files = list(shipped.folder().glob("*/*.yaml"))
    assert len(shipped.names()) == len(files) > 0


def test_help_shows_what_the_dataclass_declares() -> None:
    """The source is read, not imported; both must say the same."""
    shown = {flag.name: flag for flag in flags_of("lerobot_vtrefine.cli.pipeline.demo_config", "DemoConfig")}
    declared = {entry.name: entry for entry in fields(DemoConfig) if entry.name != "eval"}  # unused
    assert shown.keys() == declared.keys()
    assert shown["num_demos"].default == str(DemoConfig().num_demos)
    assert shown["output_dir"].default == str(DemoConfig().output_dir)
    assert [flag.name for flag in shown.values() if not flag.text] == []


def test_nested_flags_are_followed_into_their_modules() -> None:
    flags = {flag.name: flag for flag in flags_of(*RECORD, nested=True)}
    assert flags["root"].required
    assert flags["degradation.lateral_std_m"].default == "0.0"
    assert flags["env.pair"].text.startswith("round, square")
    assert "env.rules.grasped.slip_m" in flags
    assert "eval" not in flags  # declared as unused
    top = [flag for flag in flags.values() if flag.name.count(".") < 2]
    assert [flag.name for flag in top if not flag.text] == []


CONFIGS = (
    RECORD,
    ("lerobot_vtrefine.cli.pipeline.demo_config", "DemoConfig"),
    FINETUNE,
    ("lerobot_vtrefine.cli.information", "InformationConfig"),
    ("lerobot_vtrefine.cli.play", "PlayConfig"),
    ("lerobot_vtrefine.cli.bench", "BenchConfig"),
    ("lerobot_vtrefine.cli.import_dataset", "ImportConfig"),
    ("lerobot_vtrefine.cli.replay", "ReplayConfig"),
)


@pytest.mark.parametrize(("module", "name"), CONFIGS)
def test_every_flag_that_help_shows_says_what_it_is_for(module: str, name: str) -> None:
    flags = flags_of(module, name)
    below = [inner for flag in flags if flag.group for inner in flags_of(*flag.group, f"{flag.name}.")]
    assert [flag.name for flag in [*flags, *below] if not flag.text] == []


def test_comments_document_flags_too() -> None:
    flags = {f.name: f for f in flags_of(*FINETUNE)}
    assert flags["resume"].text.startswith("Continue from the last checkpoint")
    assert "--policy.path" in flags["policy"].text


def test_help_names_flags_and_no_classes_of_lerobots() -> None:
    shown = launch.help_text("lerobot_vtrefine.cli.finetune", *FINETUNE)
    assert "Config" not in shown
    assert "\n  --eval.*  " in shown


@pytest.mark.parametrize(
    ("entry", "given", "line"),
    [
        (launch.record_demos, [], "give --root=Path: Folder of the dataset"),
        (launch.record_demos, ["--config_path=vtrefine:round_grasped"], "give --root=Path: Folder"),
        (launch.replay, ["--dataset.root=."], "give --output_dir=Path"),
        (launch.finetune, ["--seed=3"], "say which task, --config_path=vtrefine:NAME or --env.type=vtrefine"),
    ],
)
def test_a_missing_flag_is_told_before_lerobot_is_loaded(entry, given, line, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["command", *given])
    monkeypatch.setattr(launch.importlib, "import_module", None)
    assert entry() == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {line}")
    assert error.endswith("--help has an example\n")


@pytest.mark.parametrize("given", ["nix", "tactile,nix", "[tactile, nix]", "tactile, nix"])
def test_lists_are_spelt_in_brackets_and_understood_without(
    given: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", f"--parts={given}"])
    assert launch.bench() == 2
    assert capsys.readouterr().err.startswith("error: --parts: unknown nix; choose from tactile, envs")
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", "--help"])
    launch.bench()
    shown = capsys.readouterr().out
    assert "--worlds=list[int]" in shown
    assert "(default: [1, 64, 1024, 4096])" in shown


def test_only_lists_get_brackets() -> None:
    given = ["--env.rgb_size=3,4", "--episodes=null", "--parts=auto", "--overwrite", "--episodes=1"]
    wanted = ["--env.rgb_size=[3,4]", *given[1:4], "--episodes=[1]"]
    flags = flags_of("lerobot_vtrefine.cli.replay", "ReplayConfig", nested=True)
    assert with_brackets(given, {flag.name for flag in flags if flag.is_list}) == wanted


def test_a_flag_may_stand_in_a_file_or_name_what_lies_below_it(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("root: outputs/demos\nenv: {type: vtrefine}\n")
    tune = ("lerobot_vtrefine.finetune.pipeline", "FinetunePipelineConfig")
    for (module, name), root in ((RECORD, ["--root=x"]), (tune, [])):
        check_arguments(flags_of(module, name), [f"--config_path={file}"])
        check_arguments(flags_of(module, name), ["--config_path", str(file)])
        check_arguments(flags_of(module, name), [*root, "--env.type=vtrefine"])


@pytest.mark.parametrize(
    ("entry", "given", "line"),
    [
        (launch.play, ["--epsiodes=3"], "unrecognized arguments: --epsiodes=3; did you mean --episodes?"),
        (
            launch.record_demos,
            ["--num-envs=3"],
            "unrecognized arguments: --num-envs=3; did you mean --num_envs?",
        ),
        (launch.demo, ["--quik"], "unrecognized arguments: --quik; did you mean --quick?"),
        (launch.play, ["--pair=round"], "unrecognized arguments: --pair=round; did you mean --env.pair?"),
        (launch.play, ["--xyzzy"], "unrecognized arguments: --xyzzy; --help lists the flags"),
        (launch.play, ["--policy.path=a/b/c"], "No such file or directory: --policy.path=a/b/c"),
        (launch.play, ["--config_path", "no.yaml"], "No such file or directory: --config_path=no.yaml"),
        (launch.replay, ["--dataset.root=a/b"], "No such file or directory: --dataset.root=a/b"),
        (
            launch.finetune,
            ["--policy.path=docs"],
            "--policy.path=docs is not a policy's own folder: name a checkpoint's pretrained_model",
        ),
        (launch.replay, ["--output_dir=README.md"], "--output_dir=README.md is a file; name a folder"),
        (
            launch.finetune,
            ["--output_dir=/etc/hosts/run"],
            "/etc/hosts/run cannot be written: /etc/hosts is a file",
        ),
        (
            launch.demo,
            ["--env={pair"],
            "--env={pair: give settings by name, such as --env='{name: value}'",
        ),
        (
            launch.import_dataset,
            ["--pads=primary"],
            "--pads=primary: give settings by name, such as --pads='{name: value}'",
        ),
        (
            launch.play,
            ["--policy.path="],
            "--policy.path= names nothing; give a file or a folder, or leave it out",
        ),
    ],
)
def test_what_is_wrong_with_a_command_line_is_told_before_lerobot_is_loaded(
    entry, given, line, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(sys, "argv", ["command", *given])
    monkeypatch.setattr(launch.importlib, "import_module", None)
    assert entry() == 2
    assert capsys.readouterr().err == f"error: {line}\n"


def test_a_package_to_import_first_is_looked_for_before_lerobot_is_loaded(monkeypatch, tmp_path) -> None:
    flags = flags_of("lerobot_vtrefine.cli.play", "PlayConfig", unused=True)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "single_file_body.py").write_text("")
    (tmp_path / "packaged_body").mkdir()
    (tmp_path / "packaged_body" / "__init__.py").write_text("raise RuntimeError('imported too early')")
    for flag in ("--env.discover_packages_path", "--policy.discover_packages_path"):
        for missing in ("no_such_body", "no_such.body", "./packaged_body", ""):
            with pytest.raises(
                ValueError, match=f"^{flag}={missing}: Python finds no such package; .*PYTHONPATH"
            ):
                check_arguments(flags, [f"{flag}={missing}"])
        with pytest.raises(ValueError, match=f"^{flag}=single_file_body is a single file; .*__init__.py"):
            check_arguments(flags, [f"{flag}=single_file_body"])
        check_arguments(flags, [f"{flag}=packaged_body"])


@pytest.mark.parametrize("below", ["pretrained_model", "checkpoints/last/pretrained_model"])
def test_the_folder_of_a_checkpoint_or_of_a_run_is_told_where_its_policy_is(below, tmp_path: Path) -> None:
    inside = tmp_path / below
    inside.mkdir(parents=True)
    (inside / "config.json").write_text("{}")
    flags = flags_of("lerobot_vtrefine.cli.play", "PlayConfig", unused=True)
    with pytest.raises(ValueError, match=f"is not a policy's own folder: take {inside}"):
        check_arguments(flags, [f"--policy.path={tmp_path}"])
    for fine in (f"--policy.path={inside}", "--policy.path=USER/insertion", "--eval.n_episodes=3"):
        check_arguments(flags, [fine])


def test_a_value_that_cannot_be_decoded_is_one_line(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "argv", ["command", f"--root={tmp_path}", "--env.fps=fast"])
    assert launch.record_demos() == 2
    error = capsys.readouterr().err
    assert error.startswith("error: `env.fps`: Couldn't parse 'fast' into an int")
    assert error.count("\n") == 1


def test_a_setting_of_the_environment_says_its_type() -> None:
    flags = flags_of(*RECORD)
    given = ["--env.pair=key"]
    assert launch.with_environment(given, flags) == ["--env.type=vtrefine", *given]
    for said in (["--env.type=x"], ["--config_path=f.yaml"], ["--config_path", "f.yaml"]):
        assert launch.with_environment([*said, *given], flags) == [*said, *given]
    assert launch.with_environment(["--env.menagerie_dir=m"], flags) == ["--env.menagerie_dir=m"]
    assert launch.with_environment(given, []) == given


def test_settings_that_go_together_are_told_as_one_flag() -> None:
    flags = flags_of("lerobot_vtrefine.cli.pipeline.demo_config", "DemoConfig")
    with pytest.raises(ValueError, match=r"at once: give --env='\{scene: \{pair: key\}\}'$"):
        check_arguments(flags, ["--env.scene.pair=key"])


def test_what_a_command_imports_is_not_looked_through_at_its_end(monkeypatch) -> None:
    frozen: list[bool] = []
    monkeypatch.setattr("gc.freeze", lambda: frozen.append(True))
    monkeypatch.setattr("sys.argv", ["vtrefine-bench"])
    fake = SimpleNamespace(main=lambda: len(frozen))
    monkeypatch.setitem(sys.modules, "lerobot_vtrefine.cli.bench", fake)
    assert launch.launch("bench", "lerobot_vtrefine.cli.bench", "BenchConfig") == 1


def test_help_goes_as_deep_as_one_asks(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["command", "--help", "env.scene"])
    assert launch.play() == 0
    shown = capsys.readouterr().out
    assert "--env.scene.clearance_m=float" in shown
    assert "--agent" not in shown


def test_help_on_a_group_that_is_not_there_names_the_one_that_was_meant(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["command", "--help", "env.sceen"])
    assert launch.play() != 0
    assert (
        "--help env.sceen: there is no such group of flags; did you mean env.scene?"
        in capsys.readouterr().err
    )


def test_help_is_text_without_markup(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-record-demos", "--help"])
    assert launch.record_demos() == 0
    shown = capsys.readouterr().out
    assert "``" not in shown
    assert "--root=Path" in shown
    assert "(required)" in shown


def test_a_shell_understands_every_example_of_help() -> None:
    texts = [umbrella.describe_module(umbrella.module_of(e))[1] for e in umbrella.commands().values()]
    lines = [line for text in texts for line in text.replace("\\\n", "").splitlines()]
    examples = [shlex.split(line, comments=True) for line in lines if line.startswith("  vtrefine-")]
    assert len(examples) > 10
    assert [words for words in examples if not all(w.startswith(("--", "...")) for w in words[1:])] == []


def test_the_umbrella_lists_commands_and_configurations(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine"])
    assert umbrella.main() == 0
    listed = capsys.readouterr().out
    assert "vtrefine-diagnose" in listed
    assert "lerobot-train" in listed
    monkeypatch.setattr(sys, "argv", ["vtrefine", "configs"])
    assert umbrella.main() == 0
    listed = capsys.readouterr().out
    assert "vtrefine:round_grasped" in listed
    rows = [line for line in listed.splitlines() if line.startswith("  vtrefine:")]
    assert len(rows) == len(shipped.names())
    assert [row for row in rows if not row.endswith(".")] == []  # whole sentences, not a comment's first half
    monkeypatch.setattr(sys, "argv", ["vtrefine", "--version"])
    assert umbrella.main() == 0
    assert capsys.readouterr().out.startswith("lerobot_policy_vtrefine ")


def test_the_umbrella_runs_a_command_as_if_called_by_its_name(monkeypatch, capsys, tmp_path: Path) -> None:
    arguments = ["diagnose", f"--recording={tmp_path / 'nowhere'}", f"--output_dir={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", ["vtrefine", *arguments])
    assert umbrella.main() == 2
    error = capsys.readouterr().err
    assert "nowhere" in error
    assert error.count("\n") == 1
    monkeypatch.setattr(sys, "argv", ["vtrefine", "diagnos"])
    assert umbrella.main() == 2
    error = capsys.readouterr().err
    assert "unknown command 'diagnos'; choose from" in error
    assert error.endswith("did you mean diagnose?\n")
    for name in ("configs", "--version"):
        monkeypatch.setattr(sys, "argv", ["vtrefine", name, "square"])
        assert umbrella.main() == 2
        assert capsys.readouterr().err == f"error: vtrefine {name} takes nothing more, got square\n"


def test_a_local_dataset_that_is_not_there_is_named(monkeypatch, tmp_path: Path) -> None:
    """LeRobot asks the Hub for it, and ends in a hundred lines about the network."""
    root, home = tmp_path / "demos", tmp_path / "home"
    monkeypatch.setattr("lerobot.utils.constants.HF_LEROBOT_HOME", home)

    def run(command: str, *flags: str, name: str = "local/demos") -> None:
        monkeypatch.setattr(sys, "argv", [f"/bin/{command}", f"--dataset.repo_id={name}", *flags])
        refuse_missing_places()

    at_root = f"--dataset.root={root}"
    with pytest.raises(SystemExit, match=f"error: {at_root} holds no recorded episodes: there is no {root}"):
        run("lerobot-train", at_root)
    with pytest.raises(SystemExit, match=f"error: {home}/local/demos .no --dataset.root was given. holds no"):
        run("lerobot-replay")
    for yes in ("true", "True", "1"):
        with pytest.raises(SystemExit, match=f"there is no {root}/meta"):
            run("lerobot-record", at_root, f"--resume={yes}")
    run("lerobot-record", at_root)
    run("lerobot-record", at_root, "--resume=false")
    run("lerobot-train", at_root, name="USER/demos")  # downloaded to this folder
    run("lerobot-train", "--config_path=settings.yaml")  # which may name the folder
    (root / "data").mkdir(parents=True)
    (root / "meta").mkdir()
    (home / "local" / "demos" / "data").mkdir(parents=True)
    run("lerobot-train", at_root)
    run("lerobot-replay")
    run("lerobot-record", at_root, "--resume=true")


def test_a_policy_that_is_not_there_is_named(monkeypatch, tmp_path: Path) -> None:
    """LeRobot tells of the name that no Hub would take, or of the network, in fifty to eighty lines."""
    own = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    own.mkdir(parents=True)
    (own / "config.json").write_text("{}")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    asked = []

    def hub(name: str, file: str) -> str:
        asked.append((name, file))
        raise answers[name](name)

    def not_found(name: str) -> Exception:
        response = httpx.Response(404, request=httpx.Request("GET", "https://hub.example"))
        return RepositoryNotFoundError(name, response=response)

    answers = {"outputs/polcy": not_found, "me/insertion": LocalEntryNotFoundError}
    monkeypatch.setattr("huggingface_hub.hf_hub_download", hub)
    monkeypatch.setattr("huggingface_hub.get_hf_file_metadata", lambda _: None)

    def told(path: str, command: str = "lerobot-eval") -> str:
        monkeypatch.setattr(sys, "argv", [f"/bin/{command}", f"--policy.path={path}"])
        try:
            refuse_missing_places()
        except SystemExit as stop:
            return str(stop)
        return ""

    nowhere = "there is no such folder; name a checkpoint's pretrained_model"
    for command in ("lerobot-train", "lerobot-eval", "lerobot-rollout"):
        assert told("outputs/a/b", command) == f"error: --policy.path=outputs/a/b: {nowhere}"
    assert told("polcy") == f"error: --policy.path=polcy: {nowhere}"
    assert told("empty").endswith("=empty is not a policy's own folder: name a checkpoint's pretrained_model")
    assert told("run").endswith("is not a policy's own folder: take run/checkpoints/last/pretrained_model")
    assert told(str(own)) == told("outputs/a/b", "lerobot-info") == ""
    assert not asked
    assert told("outputs/polcy").endswith(
        "/polcy: there is no such folder, and the Hub has no policy of this name that this account may read"
    )
    assert told("me/insertion").endswith("no such folder, and the Hub, where it may be, does not answer")
    monkeypatch.setattr("huggingface_hub.hf_hub_download", lambda *_: "config.json")
    assert told("me/insertion") == ""
    (own / "config.json").write_text("{")
    assert told(str(own)).startswith(f"error: {own}: config.json is not valid JSON (Expecting")
    (own / "config.json").write_text("[]")
    assert told(str(own)) == f"error: {own}: config.json does not hold settings by name"
    (own / "config.json").write_text("{}")
    (own / "policy_preprocessor.json").write_text("{")
    assert told(str(own)).startswith(f"error: {own}: policy_preprocessor.json is not valid JSON (Expecting")


def test_without_a_network_a_policy_of_the_hub_is_asked_for_once(monkeypatch, tmp_path: Path) -> None:
    """A download tries for half a minute; one from the cache needs no network."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["/bin/lerobot-eval", "--policy.path=me/insertion"])
    downloads = []

    def unreachable(_: str) -> None:
        raise httpx.ConnectError("Name or service not known")

    monkeypatch.setattr("huggingface_hub.get_hf_file_metadata", unreachable)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", lambda *name: downloads.append(name))
    with pytest.raises(SystemExit, match="and the Hub, where it may be, does not answer"):
        refuse_missing_places()
    assert not downloads
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *_: "/cache/config.json")
    refuse_missing_places()
    assert downloads


def test_stock_commands_get_the_path_when_they_discover_the_plugin(monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", "--config_path=vtrefine:round_table"])
    shipped.expand_command_line()
    assert Path(sys.argv[1].partition("=")[2]).is_file()
    monkeypatch.setattr(sys, "argv", ["lerobot-record", "--robot.env_file=vtrefine:round_table"])
    shipped.expand_command_line()
    assert Path(sys.argv[1].partition("=")[2]).is_file()
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", "--config_path=vtrefine:nothing"])
    with pytest.raises(SystemExit, match="error: --config_path=vtrefine:nothing: no such configuration"):
        shipped.expand_command_line()
