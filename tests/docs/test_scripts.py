"""Scripts: each in scripts/ is a command that tells how it is used, and pages name flags that it has."""

import json
import re
from pathlib import Path

import pytest
from command_uses import uses
from loaded_process import LoadedProcess

from lerobot_vtrefine.diagnose.template import write_template

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN_BY_OTHERS = {"docs_hooks"}
"""mkdocs imports it."""
SCRIPT = r"(?:\./)?scripts/(\w+)\.py"

# All in one process: importing what they need takes most of the time.
ASK = """
import contextlib, io, json, runpy, sys
_, paths, *sys.path[:0] = sys.argv
found = {}
for path in json.loads(paths):
    sys.argv = [path, "--help"]
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        try:
            status = runpy.run_path(path, run_name="__main__") and None
        except SystemExit as stop:
            status = stop.code
    found[path] = [status, out.getvalue()]
print(json.dumps(found))
"""


COMPLAIN = """
import contextlib, io, json, runpy, sys
_, calls, *sys.path[:0] = sys.argv
found = []
for call in json.loads(calls):
    sys.argv = call
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            status = runpy.run_path(call[0], run_name="__main__") and None
        except SystemExit as stop:
            status = stop.code
    found.append([status, errors.getvalue()])
print(json.dumps(found))
"""
TASK = "--config_path=configs/env/round_grasped.yaml"
BAD = {
    f"before_after {TASK} --before=x --after=x --output=FILE/x.gif": "--output=FILE/x.gif cannot be written",
    f"before_after {TASK} --before=x --after=x --output=x.gif --episodes=0": "argument --episodes: give",
    "bench_diagnose --per_cell=0": "argument --per_cell: give a whole number of at least 1, got '0'",
    "bench_jittered --seeds=2": "argument --seeds: give the first and the last + 1, such as 0:2, got '2'",
    "bench_jittered --seeds=2:1": "argument --seeds: give the first and the last + 1",
    "bench_jittered --gains=nan": "argument --gains: give numbers between 0 and 1",
    "bench_jittered --pad=0x0": "argument --pad: give rows and columns, such as 12x32, got '0x0'",
    "bench_jittered --jobs=0": "argument --jobs: give a whole number of at least 1, got '0'",
    "bench_outsider --sets=-1": "argument --sets: give a whole number of at least 1, got '-1'",
    "bench_servo --recording=PADS --output_dir=NEW": "--recording=PADS is not of a servo with a known load",
    "clone_on_features --dataset=x --output_dir=OLD": "OLD/pretrained_model exists; choose",
    "clone_on_features --dataset=x --output_dir=NEW --policy={": "argument --policy: { is not valid JSON",
    "clone_on_features --dataset=x --output_dir=NEW --policy=[1]": "argument --policy: give settings by name",
    "clone_on_features --dataset=x --output_dir=NEW --device=tpu": "--device=tpu is unknown; give",
    "collect_results reality NEW --results=NEW/rows.json": "no rows for reality in NEW",
    "compare_paper --mesh_dir=x --jobs=0": "argument --jobs: give a whole number of at least 1, got '0'",
    "compare_policies --episodes=0": "argument --episodes: give a whole number of at least 1, got '0'",
    "compare_reality --lane=nosuch --output_dir=NEW": "--lane=nosuch is unknown; choose from",
    "judge_tasks round_grasped --results=FILE": "FILE: no JSON",
    "measure_tolerance round_grasped --results=FILE": "FILE: no JSON",
    "measure_timestep --results=FILE": "FILE: no JSON",
    "measure_timestep --timesteps_s=a": "argument --timesteps_s: ",
    "profile_finetuning --worlds=1 --timestep_s=0": "timestep_s must lie in (0, 0.005] s, got 0.0",
    "profile_training --policies=nosuch": "--policies=nosuch is unknown; choose from small, pads, paper",
    "profile_training --json=FILE/x": "--json=FILE/x cannot be written: FILE is not a folder",
    "profile_finetuning --worlds=a": "argument --worlds: give a whole number of at least 1, got 'a'",
    "profile_finetuning --json=FILE/x": "--json=FILE/x cannot be written: FILE is not a folder",
    "soak_worlds --actions=nosuch": "--actions=nosuch is unknown; choose from random, trained, expert",
    "soak_worlds --rows=FILE": "FILE, line 1: not valid JSON",
    "step_in_millimetres --policy=x --task=x --results=FILE": "FILE: no JSON",
    "sysid_check --output=FILE/x": "--output=FILE/x cannot be written: FILE is not a folder",
}
"""What is wrong with the arguments of scripts, and how it is told."""


def test_bad_arguments_are_one_line_before_any_work(loaded: LoadedProcess, tmp_path: Path) -> None:
    places = {name: str(tmp_path / name.lower()) for name in ("FILE", "OLD", "NEW", "PADS")}
    Path(places["FILE"]).write_text("mine")
    (Path(places["OLD"]) / "pretrained_model").mkdir(parents=True)
    write_template(Path(places["PADS"]))

    def placed(text: str) -> str:
        for name, path in places.items():
            text = text.replace(name, path)
        return text

    calls = []
    for line in BAD:
        name, *arguments = placed(line).split()
        calls.append([str(SCRIPTS / f"{name}.py"), *arguments])
    done = loaded.run(COMPLAIN, json.dumps(calls), *map(str, (SCRIPTS, ROOT)), cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.strip().splitlines()[-1])
    for (line, wanted), (status, told) in zip(BAD.items(), found, strict=True):
        assert (status, told.count("\n")) == (2, 1), (line, told)
        assert told.startswith(f"error: {placed(wanted)}"), (line, told)
    assert Path(places["FILE"]).read_text() == "mine"


@pytest.fixture(scope="module")
def helps(loaded: LoadedProcess) -> dict[str, str]:
    """What --help of every script prints."""
    paths = [str(path) for path in sorted(SCRIPTS.glob("*.py")) if path.stem not in RUN_BY_OTHERS]
    done = loaded.run(ASK, json.dumps(paths), *map(str, (SCRIPTS, ROOT)))
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.strip().splitlines()[-1])
    assert [path for path, (status, _) in found.items() if status != 0] == []
    return {Path(path).stem: text for path, (_, text) in found.items()}


def test_every_script_tells_how_it_is_used(helps: dict[str, str]) -> None:
    for name, text in helps.items():
        assert text.startswith(f"usage: {name}.py"), name
        assert f"scripts/{name}.py" in text, f"{name} shows no example"
        bare = re.findall(r"^  (-[^\n]*\S)\n(?!   )", text + "\n", re.MULTILINE)
        assert [flag for flag in bare if "  " not in flag] == [], f"{name} does not say what these are"


def test_uses_are_found() -> None:
    text = "`scripts/a.py one --b=1`\n```bash\npython scripts/c.py --d \\\n    --e=2 && make f  # --g\n```"
    assert uses(text, SCRIPT) == [("a", ["--b"]), ("c", ["--d", "--e"])]


def test_flags_that_pages_and_scripts_give_to_scripts_exist(helps: dict[str, str]) -> None:
    shown = {page.name: page.read_text(encoding="utf-8") for page in PAGES}
    shown |= {name: f"```bash\n{text.partition('options:')[0]}```" for name, text in helps.items()}
    wrong, checked = [], 0
    for place, text in shown.items():
        for name, flags in uses(text, SCRIPT):
            passes_on = "parse_known_args" in (SCRIPTS / f"{name}.py").read_text(encoding="utf-8")
            known = set(re.findall(r"--\w+", helps[name]))
            wrong += [f"{place}: {name}.py {flag}" for flag in flags if not passes_on and flag not in known]
            checked += len(flags)
    assert wrong == []
    assert checked > 50
