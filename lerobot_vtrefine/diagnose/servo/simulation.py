"""The simulated servo: a proportional position loop that puts a voltage on a DC motor, which turns the load.

    duty = limit(duty_per_rad (command - position)),  current = (duty supply - kt speed) / resistance
    (inertia + armature) speed' = kt current - weight sin(angle) - viscous speed - friction

Friction is what would stop the shaft within the step, up to its limit (as in MuJoCo's ``frictionloss``):
Coulomb's constant in the baseline, with the laws of `stages` beyond it. A frame's command is in force until
the next one. Steps are the recording's own frames, cut where they are longer than `LONGEST_STEP_S`; torques
act in the middle of each, so that errors are of second order (position Verlet, damping by Crank and
Nicolson). Shapes: N frames, C columns (sets of parameters), T trials.
"""

import numpy as np

from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.parameters import INDEX, Values
from lerobot_vtrefine.diagnose.servo.stages import STAGES, Now, Stage

Array = np.ndarray

LONGEST_STEP_S = 0.0125
_FASTEST = 200.0
"""No servo turns faster [rad/s]."""


def simulate(bench: Bench, theta: Array) -> Array:
    """Positions (N, C, T) that follow from commands and first positions, under parameters (C, P)."""
    value: Values = {name: theta[:, place, None] for name, place in INDEX.items()}
    active = [stage for stage in STAGES if any(value[name].any() for name in stage.parameters)]
    drive = _Drive(bench, value, active)
    command, parts = drive.commands(), _parts(bench.time_s)
    angle = np.repeat(bench.position[:1] + value["offset"], 1, 0)
    speed, reading = np.zeros_like(angle), angle.copy()
    out = np.empty((len(bench.time_s), *angle.shape))
    for frame in range(len(out)):
        out[frame] = reading
        if frame == len(out) - 1:
            break
        step = (bench.time_s[frame + 1] - bench.time_s[frame]) / parts
        for _ in range(parts):
            angle = angle + 0.5 * step * speed
            reading = drive.read(reading, angle)
            speed = drive.next_speed(frame, step, command[frame] - reading, angle, speed)
            angle = angle + 0.5 * step * speed
            reading = drive.read(reading, angle)
    return out - value["offset"]


def _parts(time_s: Array) -> int:
    """Steps that a typical frame is cut into."""
    step = np.diff(time_s, axis=0)
    typical = float(np.median(step[step > 0])) if (step > 0).any() else LONGEST_STEP_S
    return max(1, int(np.ceil(typical / LONGEST_STEP_S - 1e-9)))


class _Drive:
    """Firmware, motor, load and friction of all columns and trials."""

    def __init__(self, bench: Bench, value: Values, active: list[Stage]) -> None:
        self.bench, self.value = bench, value
        self.laws = {
            place: [stage.law for stage in active if stage.place == place]
            for place in ("friction", "resistance", "duty", "delay", "play")
        }
        self.torque = np.exp(value["log_torque"])
        self.resistance = np.exp(value["log_resistance"])
        self.inertia = bench.inertia + np.exp(value["log_armature"])
        self.now = Now(np.zeros(1), np.zeros(1), bench.temperature_c[0])
        self.limit: Array = bench.max_duty * (1 + self._sum("duty", np.zeros_like(self.torque)))
        self.width = self._sum("play", np.zeros_like(self.torque))

    def _sum(self, place: str, plain: Array) -> Array:
        for law in self.laws[place]:
            plain = plain + law(self.now, self.value)
        return plain

    def commands(self) -> Array:
        """(N, C, T) as angles of the shaft, as late as they act."""
        bench = self.bench
        offset = self.value["offset"]
        if not self.laws["delay"]:
            return bench.command[:, None] + offset
        delay = self._sum("delay", np.zeros_like(offset))[:, 0]
        late = np.empty((len(bench.time_s), len(delay), len(bench.files)))
        for column, tau in enumerate(delay):
            for trial, (time_s, command) in enumerate(zip(bench.time_s.T, bench.command.T, strict=True)):
                late[:, column, trial] = np.interp(time_s - tau, time_s, command)
        return late + offset

    def next_speed(self, frame: int, step: Array, error: Array, angle: Array, speed: Array) -> Array:
        """(C, T) after a step [s] (T,)."""
        bench, now, on = self.bench, self.now, self.bench.torque_on[frame]
        now.speed, now.temperature_c = speed, bench.temperature_c[frame]
        now.duty = np.minimum(np.maximum(bench.duty_per_rad * error, -self.limit), self.limit)
        resistance = self.resistance
        if self.laws["resistance"]:
            resistance = resistance * self._sum("resistance", np.ones_like(resistance))
        per_volt = self.torque / resistance * on
        driven, braked = per_volt * (now.duty * bench.supply_v), per_volt * self.torque
        now.gravity = -bench.weight * np.sin(angle)
        now.motor = driven - braked * speed
        friction = self._sum("friction", self.value["coulomb"])
        damping = 0.5 * step * (self.value["viscous"] + braked)
        damped = self.inertia + damping
        free = ((self.inertia - damping) * speed + step * (driven + now.gravity)) / damped
        slower = np.maximum(np.abs(free) - step * friction / damped, 0.0)
        return np.copysign(np.minimum(slower, _FASTEST), free)

    def read(self, reading: Array, angle: Array) -> Array:
        """What the encoder says (C, T), behind its play."""
        if not self.laws["play"]:
            return angle
        return np.minimum(np.maximum(reading, angle - self.width / 2), angle + self.width / 2)
