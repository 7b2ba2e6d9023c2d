"""What the processor files of a checkpoint may name: nothing else is imported, built or read."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import factory
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry
from safetensors.torch import save_file

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY
from lerobot_vtrefine.lerobot_compat import checkpoint_guard
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import make_vt_dp3_pre_post_processors

PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"
OUTSIDE = """
from pathlib import Path
from lerobot.processor import ProcessorStep

Path({marker!r}).touch()

class Step(ProcessorStep):
    def __call__(self, transition):
        return transition

    def transform_features(self, features):
        return features
"""


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that exists once ``steps_of_a_user`` was imported; LeRobot's guard is as in a new process."""
    monkeypatch.setattr(checkpoint_guard, "_restricted", False)
    (tmp_path / "steps_of_a_user.py").write_text(OUTSIDE.format(marker=str(tmp_path / "ran")))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "steps_of_a_user", raising=False)
    return tmp_path / "ran"


def config_of_ours() -> VtDp3Config:
    features = {STATE_KEY: PolicyFeature(FeatureType.STATE, (16,))}
    actions = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (16,))}
    return VtDp3Config(preset="small", device="cpu", input_features=features, output_features=actions)


def checkpoint(folder: Path, *steps: dict, file: str = PRE) -> Path:
    """Processor files of ``vt_dp3``, with ``steps`` appended to one of them."""
    for processor in make_vt_dp3_pre_post_processors(config_of_ours()):
        processor.save_pretrained(folder)
    saved = json.loads((folder / file).read_text())
    saved["steps"] += steps
    (folder / file).write_text(json.dumps(saved))
    return folder


def load(folder: Path) -> None:
    for file in (PRE, POST):
        PolicyProcessorPipeline.from_pretrained(folder, file)


def touching(path: Path, name: str = "subprocess.Popen", argument: str = "args") -> dict:
    value = ["touch", str(path)] if argument == "args" else f"touch {path}"
    return {"class": name, "config": {argument: value}}


@pytest.mark.parametrize("file", [PRE, POST])
def test_a_command_in_a_checkpoint_is_refused_and_not_run(tmp_path, marker, file) -> None:
    folder = checkpoint(tmp_path / "evil", touching(marker), file=file)
    with pytest.raises(
        ValueError, match=rf"{file} of .*evil: step \d names the class 'subprocess.Popen'"
    ) as no:
        load(folder)
    assert "\n" not in str(no.value)
    assert not marker.exists()


@pytest.mark.parametrize(
    "step",
    [
        {"class": "steps_of_a_user.Step"},
        {"class": "lerobot.processor.pipeline.importlib"},
        {"class": "lerobot.processor.pipeline.DataProcessorPipeline"},
        {"class": "lerobot.processor..Step"},
        {"class": "lerobot.processor/../../steps_of_a_user.Step"},
        {"class": "lerobot_vtrefine_steps.Step"},
        {"class": "lerobot.processor.ActionTokenizerProcessorStep", "config": {"action_tokenizer_name": "x"}},
        {"registry_name": "action_tokenizer_processor", "config": {"action_tokenizer_name": "someone/code"}},
        {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "someone/code"}},
        {"registry_name": "reward_classifier_processor", "config": {"pretrained_path": "someone/model"}},
        {"registry_name": "eo1_qwen_processor", "config": {"processor_name": "someone/code"}},
        {"registry_name": "unknown"},
        {"registry_name": None, "class": "steps_of_a_user.Step"},
        {"registry_name": ["device_processor"]},
        {"class": "Step"},
        {"class": 5},
        {"registry_name": "device_processor", "config": ["cpu"]},
        {"registry_name": "normalizer_processor", "state_file": "../../elsewhere.safetensors"},
        {"registry_name": "normalizer_processor", "state_file": "/elsewhere.safetensors"},
        {"registry_name": "normalizer_processor", "state_file": "state.pt"},
        {"registry_name": "normalizer_processor", "state_file": ["state.safetensors"]},
    ],
)
def test_nothing_else_is_imported_or_built(tmp_path, marker, step) -> None:
    folder = checkpoint(tmp_path / "evil", {"class": "lerobot.processor.IdentityProcessorStep"}, step)
    save_file({"x": torch.zeros(1)}, tmp_path / "elsewhere.safetensors")
    with pytest.raises(ValueError, match=rf"{PRE} of .*: step 6 .*; nothing of it was run") as refused:
        load(folder)
    assert "\n" not in str(refused.value)
    assert not marker.exists()


def test_steps_of_lerobot_this_package_and_other_plugins_load(tmp_path, marker) -> None:
    @ProcessorStepRegistry.register("step_of_a_plugin")
    class Plugin(checkpoint_guard.ProcessorStep):
        def __call__(self, transition):
            return transition

        def transform_features(self, features):
            return features

    try:
        load(
            checkpoint(
                tmp_path / "good",
                {"class": "lerobot.processor.rename_processor.RenameObservationsProcessorStep", "config": {}},
                {"class": "lerobot.processor.IdentityProcessorStep"},
                {"registry_name": "step_of_a_plugin"},
            )
        )
    finally:
        ProcessorStepRegistry.unregister("step_of_a_plugin")


def test_other_policies_keep_their_own_steps_but_call_nothing_that_is_no_step(tmp_path, marker) -> None:
    assert ACTConfig(device="cpu").type == "act"
    own = checkpoint(tmp_path / "own", {"class": "steps_of_a_user.Step"})
    loader = checkpoint(tmp_path / "loader", {"registry_name": "tokenizer_processor"})
    commands = [
        checkpoint(tmp_path / name, touching(tmp_path / "called", name, argument))
        for name, argument in (("subprocess.Popen", "args"), ("os.system", "command"))
    ]
    checkpoint_guard._restricted = False  # making these files made configurations of vt_dp3
    load(own)
    assert marker.exists()
    for folder in commands:
        with pytest.raises(ValueError, match="is not a processor step"):
            load(folder)
    assert not (tmp_path / "called").exists()
    with pytest.raises(ValueError, match=r"[Tt]okenizer_?[Pp]rocessor"):  # LeRobot's own words
        load(loader)


def test_another_policy_keeps_its_own_steps_after_one_of_ours(tmp_path, marker, monkeypatch) -> None:
    """In a notebook, say: what LeRobot makes processors for counts, and not what was used before."""
    monkeypatch.setattr(factory, "make_pre_post_processors", factory.make_pre_post_processors)
    notebook = SimpleNamespace(make_pre_post_processors=factory.make_pre_post_processors)
    monkeypatch.setitem(sys.modules, "lerobot.notebook", notebook)
    own = checkpoint(tmp_path / "own", {"class": "steps_of_a_user.Step"})
    ours, other = config_of_ours(), ACTConfig(device="cpu")
    for make in (factory.make_pre_post_processors, notebook.make_pre_post_processors):
        with pytest.raises(ValueError, match="vt_dp3 loads registered processor steps"):
            make(ours, pretrained_path=str(own))
        with pytest.raises(ValueError, match="vt_dp3 loads registered processor steps"):
            make(policy_cfg=ours, pretrained_path=str(own))
        assert not marker.exists()
    with pytest.raises(ValueError, match="vt_dp3 loads registered processor steps"):
        load(own)
    assert not marker.exists()
    for make in (factory.make_pre_post_processors, notebook.make_pre_post_processors):
        assert type(make(other, pretrained_path=str(own))[0].steps[-1]).__name__ == "Step"
    config_of_ours()
    assert factory.make_pre_post_processors.__wrapped__ is notebook.make_pre_post_processors.__wrapped__
    assert not hasattr(factory.make_pre_post_processors.__wrapped__, "__wrapped__")
    with pytest.raises(ValueError, match="vt_dp3 loads registered processor steps"):
        load(own)
