"""The same servos identified twice: by ``vtrefine-diagnose``'s baseline, and by MuJoCo's own toolbox.

    pip install 'mujoco[sysid]'
    python scripts/sysid_check.py
    python scripts/collect_results.py sysid outputs/sysid.md --replace && make tables

mujoco.sysid fits a pendulum of MuJoCo's own: armature, dry friction, damping, the motor's torque per volt and
where the load hangs, by rollouts of MjModel in steps of half a millisecond. It shares with the baseline only
the reader of recordings. The motor's back-EMF acts as damping, so the baseline's is its viscous friction and
back-EMF together. Two sets: a generated one, whose truth is known, and the real servo of tests/data.
"""

import importlib
import logging
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from lerobot_vtrefine.cli import import_dataset
from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_file
from lerobot_vtrefine.diagnose.recordings import read_recording_set
from lerobot_vtrefine.diagnose.servo.bench import GRAVITY_M_S2, Bench
from lerobot_vtrefine.diagnose.servo.parameters import INDEX
from lerobot_vtrefine.diagnose.servo.problem import ServoProblem

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "diagnose"))
servo_rig = importlib.import_module("servo_rig")

Array = np.ndarray
Values = dict[str, float]
Modifiers = dict[str, Callable[[mujoco.MjSpec, float], None]]

STEP_S = 5e-4
NAMES = {
    "torque per volt": "mNm/V",
    "damping with back-EMF": "mNm s/rad",
    "dry friction": "mNm",
    "armature": "g m²",
    "offset": "mrad",
}
"""What is shown in thousandths of SI units."""
LIMITS = {
    "torque per volt": (0.15, 0.01, 1.0),
    "damping with back-EMF": (0.05, 1e-4, 0.5),
    "dry friction": (0.03, 1e-4, 0.3),
    "armature": (3e-3, 1e-5, 0.05),
    "offset": (0.005, -0.2, 0.2),
}
"""Start and ends [SI units]."""


def by_the_baseline(bench: Bench) -> tuple[Values, float]:
    """What vtrefine-diagnose's simulated servo is fitted to, and its root mean squared error [rad]."""
    problem = ServoProblem.of(bench)
    fit = problem.baseline()
    if (whole := problem.finer()) is not None:
        fit = whole.refitted(fit)
    value = {name: float(fit.theta[place]) for name, place in INDEX.items()}
    torque, ohm = np.exp(value["log_torque"]), np.exp(value["log_resistance"])
    found = {
        "torque per volt": torque / ohm,
        "damping with back-EMF": value["viscous"] + torque**2 / ohm,
        "dry friction": value["coulomb"],
        "armature": float(np.exp(value["log_armature"])),
        "offset": value["offset"],
    }
    return found, float(np.sqrt(fit.mse.mean()))


def pendulum(bench: Bench, trial: int) -> mujoco.MjSpec:
    """A servo with a trial's load and gain, before anything is fitted."""
    spec = mujoco.MjSpec()
    spec.modelname = bench.files[trial]
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0, 0, -GRAVITY_M_S2]
    length = bench.inertia[trial] * GRAVITY_M_S2 / bench.weight[trial]
    mass = bench.weight[trial] / GRAVITY_M_S2 / length
    body = spec.worldbody.add_body(name="load", mass=mass, ipos=[0, 0, -length], inertia=[1e-9] * 3)
    body.explicitinertial = True
    body.add_joint(name="shaft", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    servo = spec.add_actuator(name="servo", target="shaft", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    servo.forcelimited = True
    spec.add_sensor(
        name="angle",
        type=mujoco.mjtSensor.mjSENS_JOINTPOS,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        objname="shaft",
    )
    return spec


def modifiers(bench: Bench, trial: int) -> Modifiers:
    """How each value enters a trial's model."""
    volts_per_rad = bench.duty_per_rad[trial] * bench.supply_v[trial]
    most_volts = bench.max_duty[trial] * bench.supply_v[trial]

    def torque(spec: mujoco.MjSpec, value: float) -> None:
        servo = spec.actuator("servo")
        servo.gainprm[0] = value * volts_per_rad
        servo.biasprm[1] = -value * volts_per_rad
        servo.forcerange = [-value * most_volts, value * most_volts]

    def offset(spec: mujoco.MjSpec, value: float) -> None:
        spec.body("load").quat = [np.cos(value / 2), 0, np.sin(value / 2), 0]

    def joint(name: str) -> Callable[[mujoco.MjSpec, float], None]:
        return lambda spec, value: setattr(spec.joint("shaft"), name, value)

    return {
        "torque per volt": torque,
        "damping with back-EMF": lambda spec, value: spec.joint("shaft").damping.__setitem__(0, value),
        "dry friction": joint("frictionloss"),
        "armature": joint("armature"),
        "offset": offset,
    }


def by_mujoco(bench: Bench) -> tuple[Values, float]:
    """What mujoco.sysid finds, and its root mean squared error [rad]."""
    from mujoco import sysid

    how = {file: modifiers(bench, trial) for trial, file in enumerate(bench.files)}
    parameters = sysid.ParameterDict()
    for name, limits in LIMITS.items():
        parameters.add(
            sysid.Parameter(
                name, *limits, modifier=lambda spec, item: how[spec.modelname][item.name](spec, item.value[0])
            )
        )
    sequences = []
    for trial, file in enumerate(bench.files):
        spec = pendulum(bench, trial)
        write(spec, how[file], {name: start for name, (start, _, _) in LIMITS.items()})
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[0] = bench.position[0, trial]
        begin = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
        rows, times = driven(bench, trial)
        control = sysid.TimeSeries(times, bench.command[rows, trial][:, None])
        angle = sysid.TimeSeries.from_names(times, bench.position[rows, trial][:, None], model)
        sequences.append(sysid.ModelSequences(file, spec, file, begin, control, angle))
    residual = sysid.build_residual_fn(models_sequences=sequences)
    found, _ = sysid.optimize(parameters, residual, optimizer="mujoco", verbose=False)
    values = {name: float(found[name].value[0]) for name in LIMITS}
    return values, error(bench, values)


def driven(bench: Bench, trial: int) -> tuple[Array, Array]:
    """The frames until the servo lets go, and their times from the first on [s]."""
    rows = np.flatnonzero(bench.valid[:, trial] & (np.cumprod(bench.torque_on[:, trial]) > 0))
    return rows, bench.time_s[rows, trial] - bench.time_s[0, trial]


def write(spec: mujoco.MjSpec, how: Modifiers, values: Values) -> mujoco.MjSpec:
    """The model with these values."""
    for name, modify in how.items():
        modify(spec, values[name])
    return spec


def error(bench: Bench, values: Values) -> float:
    """Root of the mean over trials of the mean squared error of a rollout in MuJoCo [rad]."""
    errors = []
    for trial in range(len(bench.files)):
        model = write(pendulum(bench, trial), modifiers(bench, trial), values).compile()
        data = mujoco.MjData(model)
        data.qpos[0] = bench.position[0, trial]
        rows, at = driven(bench, trial)
        steps = np.arange(round(at[-1] / STEP_S) + 1)
        command = np.interp(steps * STEP_S, at, bench.command[rows, trial])
        angle = np.empty(len(steps))
        for step in steps:
            angle[step] = data.qpos[0]
            data.ctrl[0] = command[step]
            mujoco.mj_step(model, data)
        errors.append(np.square(np.interp(at, steps * STEP_S, angle) - bench.position[rows, trial]).mean())
    return float(np.sqrt(np.mean(errors)))


def generated(folder: Path) -> tuple[Bench, Values]:
    """Servos with Coulomb and viscous friction, and what they were made with."""
    bench = Bench.of(
        read_recording_set(servo_rig.make_set(folder / "generated", servo_rig.plain, wobble=0.0))
    )
    truth = {
        "torque per volt": servo_rig.KT / servo_rig.OHM,
        "damping with back-EMF": servo_rig.VISCOUS + servo_rig.KT**2 / servo_rig.OHM,
        "dry friction": servo_rig.COULOMB,
        "armature": servo_rig.ARMATURE,
        "offset": 0.0,
    }
    return bench, truth


def real(folder: Path) -> Bench:
    """The Dynamixel XL330 of tests/data."""
    source = ROOT / "tests" / "data" / "bam_xl330.npz"
    sys.argv = ["vtrefine-import", f"--source={source}", f"--recording_dir={folder / 'xl330'}"]
    import_dataset.main()
    return Bench.of(read_recording_set(folder / "xl330"))


def table(columns: dict[str, tuple[Values, float | None]]) -> str:
    """One row a value, one column a way to find it."""
    head = ["", *columns]
    rows = [
        [f"{name} [{unit}]", *(f"{1e3 * values[name]:.2f}" for values, _ in columns.values())]
        for name, unit in NAMES.items()
    ]
    rms = ["-" if left is None else f"{1e3 * left:.2f}" for _, left in columns.values()]
    rows.append(["error on these runs [mrad]", *rms])
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


@run_cli
def main() -> None:
    """Fit both sets by both."""
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("outputs/sysid.md"),
        help="file of the table (default: %(default)s)",
    )
    options = parser.parse_args()
    check_file("--output", options.output)
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as name:
        bench, truth = generated(Path(name))
        columns: dict[str, tuple[Values, float | None]] = {"generated: truth": (truth, None)}
        columns |= {"generated: ours": by_the_baseline(bench), "generated: mujoco.sysid": by_mujoco(bench)}
        bench = real(Path(name))
        columns |= {"XL330: ours": by_the_baseline(bench), "XL330: mujoco.sysid": by_mujoco(bench)}
    options.output.write_text(table(columns) + "\n", encoding="utf-8")
    print(table(columns))


if __name__ == "__main__":
    raise SystemExit(main())
