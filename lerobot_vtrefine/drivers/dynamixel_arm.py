"""One Interbotix arm on LeRobot's Dynamixel bus: joints in radians, both fingers in metres.

Joint angle = (position - 2048) * 2 pi / 4096, the convention of Interbotix's own driver, after the motor's
homing offset. The gripper's servo drives both fingers at once; a finger's travel is proportional to the
servo's angle between the two calibrated ends (ALOHA's own 31 recorded episodes lie on such a line, 29.4
mm/rad).
"""

import logging
import math
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

import numpy as np
from lerobot.motors import MotorCalibration
from lerobot.motors.dynamixel import DynamixelMotorsBus, OperatingMode
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.arm_models import GRIPPER, ArmModel
from lerobot_vtrefine.drivers.ports import (
    GONE,
    PortError,
    ask_for_low_latency,
    explain_open_error,
    latency_advice,
)

logger = logging.getLogger(__name__)

Floats = NDArray[np.float64]

COUNTS_PER_TURN = 4096
CENTRE = COUNTS_PER_TURN // 2

RETRIES = 4
"""Repeated tries of a bus transaction: single packets do get lost, and a busy machine answers late."""

PING_RETRIES = 2
"""Repeated tries to reach a motor that may not be there."""

ANSWER_WAIT_S = 0.002
"""How long one look for an answer waits; without, the SDK keeps a processor busy until it comes [s]."""

MOVE_RATE_HZ = 50.0

FULL_PWM = 885
"""Full voltage in PWM registers (ROBOTIS e-Manual, X series)."""

_X540_MA = 2.69
"""Milliamperes per count of current registers (ROBOTIS e-Manual, XM430 and XM540)."""


def counts_to_rad(counts: Floats) -> Floats:
    """Joint angles of motor positions."""
    return (counts - CENTRE) * (2 * math.pi / COUNTS_PER_TURN)


def rad_to_counts(angles: Floats) -> Floats:
    """Motor positions of joint angles, rounded."""
    return np.rint(angles * (COUNTS_PER_TURN / (2 * math.pi)) + CENTRE)


class DynamixelArm:
    """One arm, eight values: six joints [rad], left finger >= 0 and right finger <= 0 [m]."""

    def __init__(self, name: str, port: str, model: ArmModel, travel_m: float) -> None:
        self.name = name
        self.model = model
        self.travel_m = travel_m
        self.calibration: dict[str, MotorCalibration] = {}
        self.bus = DynamixelMotorsBus(port, model.bus_motors())
        self.holding = False
        self._last: tuple[float, Floats] = (-math.inf, np.zeros(8))
        self._names = [motor for motor, _, _ in model.motors]

    @property
    def port(self) -> str:
        """Serial port."""
        return self.bus.port

    @property
    def is_connected(self) -> bool:
        """Whether the port is open."""
        return self.bus.is_connected

    # --- connection ---------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the port and check that every motor answers and is of the right model.

        Raises:
            PortError: the message names the port, the motors and the fix.
        """
        try:
            self._open()
            if advice := latency_advice(self.port):  # a control period waits for several answers
                logger.warning("%s arm: %s", self.name, advice)
            with self._talking():
                problem = self._motor_problem()
            if problem:
                raise PortError(f"{self.name} arm on {self.port}: {problem}")
        except BaseException:
            self._close()
            raise

    def _open(self) -> None:
        """Open the port, for this program alone."""
        try:
            self.bus.connect(handshake=False)
            device = self.bus.port_handler.ser
            device.exclusive = True  # the SDK would share it, and two programs take each other's answers
            device.timeout = ANSWER_WAIT_S
        except GONE as error:
            cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
            message = explain_open_error(self.port, self.bus.default_baudrate, cause)
            raise PortError(f"{self.name} arm: {message}") from error
        ask_for_low_latency(device)

    @contextmanager
    def _talking(self) -> Generator[None]:
        """Errors of the bus as one that names arm and port.

        LeRobot raises RuntimeError where a motor answers with an error, such as an overload.
        """
        try:
            yield
        except (*GONE, RuntimeError) as error:
            if isinstance(error, PortError):
                raise
            raise PortError(f"{self.name} arm ({self.port}): {error}") from error

    def _motor_problem(self) -> str:
        """What is wrong with the motors on the bus; empty when all answer and are of the right model."""
        models: dict[str, int | None] = {}
        alerting = []
        for name, motor in self.bus.motors.items():
            try:
                models[name] = self.bus.ping(motor.id, num_retry=PING_RETRIES, raise_on_error=True)
            except ConnectionError:
                models[name] = None
            except RuntimeError:  # it answers, with its alert bit set
                alerting.append(f"{name} (id {motor.id})")
        if alerting:
            return (
                f"{', '.join(alerting)} report a hardware error (overload, heat or voltage): free the arm, "
                "then switch its power off and on"
            )
        if all(model is None for model in models.values()):
            return (
                f"no motor answers at {self.bus.default_baudrate} baud: switch on the arm's power, and check "
                "that this is its port, and the motors' ids and baud rate (lerobot-setup-motors sets them)"
            )
        missing = [
            f"{name} (id {self.bus.motors[name].id})" for name, model in models.items() if model is None
        ]
        if missing:
            return f"{', '.join(missing)} do not answer: check the cable before the first of them"
        expected = {name: self.bus.model_number_table[motor.model] for name, motor in self.bus.motors.items()}
        if models != expected:
            arm = self.model.motors[0][2]
            return f"these are not the motors of a {arm} arm: are leader and follower swapped?"
        return ""

    def disconnect(self, *, torque_off: bool) -> None:
        """Close the port; torque goes off before where wanted.

        Raises:
            PortError: torque may still be on; the message names the motors. The port is closed.
        """
        try:
            if torque_off and self.is_connected:
                self._torque_off()
        finally:
            self._close()
            self.holding = False

    def _torque_off(self) -> None:
        """Switch off motor by motor: one that does not answer must not keep the others driven."""
        failed: dict[str, Exception] = {}
        for motor in self.bus.motors:
            self.bus.port_handler.is_using = False  # an interrupted read leaves it set
            try:
                self.bus.disable_torque(motor, num_retry=RETRIES)
            except (*GONE, RuntimeError) as error:
                failed[motor] = error
        if failed:
            why = str(next(iter(failed.values()))).strip()
            where = f"{self.name} arm ({self.port})"
            raise PortError(f"{where}: torque may still be on in {', '.join(failed)}: {why}")

    def _close(self) -> None:
        self.bus.port_handler.is_using = False  # otherwise the SDK calls the port busy from an error on
        if self.is_connected:
            self.bus.port_handler.closePort()

    # --- calibration --------------------------------------------------------------------------------

    @property
    def is_calibrated(self) -> bool:
        """Whether a calibration is loaded and the motors hold its homing offsets."""
        if set(self.calibration) != set(self._names):
            return False
        with self._talking():
            offsets = self.bus.sync_read("Homing_Offset", self._names, normalize=False, num_retry=RETRIES)
        return all(offsets[name] == self.calibration[name].homing_offset for name in self._names)

    def calibrate(
        self, ask: Callable[[str], str], lower: Floats, upper: Floats
    ) -> dict[str, MotorCalibration]:
        """Find the joints' zero and the gripper's two ends, by hand, with torque off; write them to the
        motors.

        Args:
            ask: Shows a text, returns what the operator typed.
            lower: Lower joint limits (6,) [rad]; `upper` the upper ones.
            upper: See lower.
        """
        with self._talking():
            self.bus.disable_torque(num_retry=RETRIES)
        joints = list(self.model.joints)
        answer = ask(
            f"{self.name} arm: hold it in its zero pose (upper arm upright, forearm level, gripper straight) "
            "and press ENTER; or type k and ENTER to keep the zeros as assembled: "
        )
        self._write_offsets(dict.fromkeys(self._names, 0))
        offsets = dict.fromkeys(self._names, 0)
        if answer.strip().lower() != "k":
            offsets |= {name: CENTRE - count for name, count in self._counts(joints).items()}
        ask(f"{self.name} arm: close the gripper fully and press ENTER: ")
        closed = self._counts([GRIPPER])[GRIPPER]
        ask(f"{self.name} arm: open the gripper fully and press ENTER: ")
        opened = self._counts([GRIPPER])[GRIPPER]
        if abs(opened - closed) < COUNTS_PER_TURN // 40:
            moved = f"{closed} to {opened} counts"
            raise ValueError(f"{self.name} arm: the gripper hardly moved ({moved}); calibrate again")
        low = np.clip(rad_to_counts(lower), 0, COUNTS_PER_TURN - 1).astype(int)
        high = np.clip(rad_to_counts(upper), 0, COUNTS_PER_TURN - 1).astype(int)
        ranges = {name: (int(a), int(b)) for name, a, b in zip(joints, low, high, strict=True)}
        ranges[GRIPPER] = (closed, opened)
        ids = {name: self.bus.motors[name].id for name in self._names}
        self.calibration = {n: MotorCalibration(ids[n], 0, offsets[n], *ranges[n]) for n in self._names}
        self.write_calibration()
        return self.calibration

    def write_calibration(self) -> None:
        """Switch torque off, and write the loaded calibration's homing offsets to the motors."""
        with self._talking():
            self.bus.disable_torque(num_retry=RETRIES)
        self._write_offsets({name: entry.homing_offset for name, entry in self.calibration.items()})

    def _write_offsets(self, offsets: dict[str, int]) -> None:
        followed = {name: motor for name, _, _, motor in self.model.shadows}
        with self._talking():
            for name, offset in offsets.items():
                self.bus.write("Homing_Offset", name, offset, normalize=False, num_retry=RETRIES)
            for shadow, motor in followed.items():
                self.bus.write("Homing_Offset", shadow, offsets[motor], normalize=False, num_retry=RETRIES)

    # --- set-up -------------------------------------------------------------------------------------

    def setup_motors(self, ask: Callable[[str], str]) -> None:
        """Give every motor its id and baud rate, the last one first; each must be alone on the bus.

        Args:
            ask: Shows a text, returns what the operator typed.
        """
        for name in reversed(self.bus.motors):
            ask(f"{self.name} arm: connect motor {name} alone, and press ENTER: ")
            self.bus.setup_motor(name)
            logger.info("%s arm: %s has id %d", self.name, name, self.bus.motors[name].id)
        self.disconnect(torque_off=False)

    def set_up(self) -> None:
        """Switch torque off and set what leader and follower share: shadows, and answers without delay."""
        with self._talking():
            self.bus.disable_torque(num_retry=RETRIES)
            for shadow, _, _, motor in self.model.shadows:
                self.bus.write("Secondary_ID", shadow, self.bus.motors[motor].id, num_retry=RETRIES)
            for motor in self.bus.motors:  # LeRobot's configure_motors never tries again
                self.bus.write("Return_Delay_Time", motor, 0, num_retry=RETRIES)

    def configure(self, gripper_current_ma: float, torque_limit: float) -> None:
        """Set shadows, modes and limits of a driven arm, with torque off.

        Joints are held by the motors themselves within the calibrated limits (position mode), with a torque
        that their PWM limit bounds. The gripper's force is limited by its current.

        Args:
            gripper_current_ma: Current limit of the gripper's motor [mA].
            torque_limit: Largest share of the joints' full torque, above 0, at most 1.
        """
        self.set_up()
        with self._talking():
            self._set_modes_and_limits(gripper_current_ma, torque_limit)

    def _set_modes_and_limits(self, gripper_current_ma: float, torque_limit: float) -> None:
        bus = self.bus
        for name in self.model.joints:
            bus.write("Operating_Mode", name, OperatingMode.POSITION.value, num_retry=RETRIES)
            limits = self.calibration[name]
            bus.write("Min_Position_Limit", name, limits.range_min, num_retry=RETRIES)
            bus.write("Max_Position_Limit", name, limits.range_max, num_retry=RETRIES)
        for name in (*self.model.joints, *(shadow for shadow, *_ in self.model.shadows)):
            bus.write("PWM_Limit", name, round(FULL_PWM * torque_limit), num_retry=RETRIES)
        bus.write("Operating_Mode", GRIPPER, OperatingMode.CURRENT_POSITION.value, num_retry=RETRIES)
        bus.write("Goal_Current", GRIPPER, round(gripper_current_ma / _X540_MA), num_retry=RETRIES)

    def hold(self) -> None:
        """Switch torque on where the arm is: goals become the present positions first, nothing jumps."""
        self.write(self.read())
        with self._talking():
            self.bus.enable_torque(self._names, num_retry=RETRIES)
        self.holding = True

    def move_to(self, target: Floats, seconds: float) -> None:
        """Move slowly along a straight line in joint space, (8,) [rad, m]."""
        start = self.read()
        steps = max(1, round(seconds * MOVE_RATE_HZ))
        for step in range(1, steps + 1):
            self.write(start + (target - start) * (step / steps))
            time.sleep(1.0 / MOVE_RATE_HZ)

    # --- state and targets --------------------------------------------------------------------------

    def read(self) -> Floats:
        """Measured state (8,): six joints [rad], left and right finger [m]."""
        ends = self._gripper_ends()
        counts = self._counts(self._names)
        joints = counts_to_rad(np.array([counts[name] for name in self.model.joints], float))
        share = (counts[GRIPPER] - ends.range_min) / (ends.range_max - ends.range_min)
        state = np.array([*joints, share * self.travel_m, -share * self.travel_m])
        self._last = time.monotonic(), state
        return state

    def recent(self, max_age_s: float) -> Floats:
        """The state as it was last read (8,), read anew where that is longer ago than `max_age_s`."""
        read_s, state = self._last
        return state if time.monotonic() - read_s <= max_age_s else self.read()

    def write(self, target: Floats) -> None:
        """Send targets (8,); the gripper follows the left finger, the right one mirrors it."""
        ends = self._gripper_ends()
        gripper = ends.range_min + target[6] / self.travel_m * (ends.range_max - ends.range_min)
        goals = dict(zip(self.model.joints, rad_to_counts(target[:6]).astype(int).tolist(), strict=True))
        goals[GRIPPER] = round(float(gripper))
        with self._talking():
            self.bus.sync_write("Goal_Position", goals, normalize=False, num_retry=RETRIES)

    def _gripper_ends(self) -> MotorCalibration:
        if GRIPPER not in self.calibration:
            raise ValueError(f"{self.name} arm ({self.port}) is not calibrated; run lerobot-calibrate")
        return self.calibration[GRIPPER]

    def _counts(self, names: list[str]) -> dict[str, int]:
        with self._talking():
            read = self.bus.sync_read("Present_Position", names, normalize=False, num_retry=RETRIES)
        return {name: int(value) for name, value in read.items()}
