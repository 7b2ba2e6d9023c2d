"""Dynamixel X-series motors on a pseudo-terminal, protocol 2.0: what a bus of ALOHA arms answers.

Source: ROBOTIS e-Manual, protocol 2.0 and the X-series control table. Ping, read, write, sync read and sync
write are emulated, with secondary ids (shadow motors), EEPROM that is locked while torque is on, and
positions that move to their goal at a limited speed.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_vtrefine.drivers.emulated_port import EmulatedPort

HEADER = b"\xff\xff\xfd\x00"
BROADCAST_ID = 0xFE
PING, READ, WRITE, STATUS, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x55, 0x82, 0x83

ERROR_ACCESS = 0x07
"""Status error: the register is read-only or locked."""

ALERT = 0x80
"""Bit of every status error of a motor that shut down, for example after an overload."""

_EEPROM_END = 64
_MODEL, _ID, _SECONDARY_ID, _HOMING_OFFSET = 0, 7, 12, 20
_TORQUE_ENABLE, _GOAL_POSITION, _PRESENT_POSITION = 64, 116, 132
_NO_SECONDARY = 255


def _crc_table() -> tuple[int, ...]:
    table = []
    for octet in range(256):
        crc = octet << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """CRC-16 of protocol 2.0 (polynomial 0x8005, initial value 0)."""
    crc = 0
    for octet in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ octet]
    return crc


def packet(motor_id: int, instruction: int, parameters: bytes) -> bytes:
    """A packet with byte stuffing and checksum."""
    body = (bytes([instruction]) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    head = HEADER + bytes([motor_id]) + (len(body) + 2).to_bytes(2, "little")
    return head + body + crc16(head + body).to_bytes(2, "little")


@dataclass
class EmulatedMotor:
    """One motor: its registers, and where its shaft is.

    Attributes:
        motor_id: Bus id.
        model_number: As in the control table's first register.
        shaft: Position of the shaft before the homing offset [counts, 4096 per turn].
        speed: How fast the shaft follows its goal [counts/s].
        alert: Whether the motor shut down: it answers, obeys, and stays without torque.
    """

    motor_id: int
    model_number: int
    shaft: float = 2048.0
    speed: float = 8000.0
    alert: bool = False
    memory: bytearray = field(default_factory=lambda: bytearray(256))
    moved_at_s: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.store(_MODEL, self.model_number, 2)
        self.store(_ID, self.motor_id, 1)
        self.store(_SECONDARY_ID, _NO_SECONDARY, 1)
        self.store(_GOAL_POSITION, round(self.shaft), 4)

    def load(self, address: int, length: int) -> int:
        """A register as a signed number."""
        return int.from_bytes(self.memory[address : address + length], "little", signed=length == 4)

    def store(self, address: int, value: int, length: int) -> None:
        """Set a register, whatever the torque."""
        self.memory[address : address + length] = value.to_bytes(length, "little", signed=value < 0)

    @property
    def torque(self) -> bool:
        """Whether the motor is driven."""
        return bool(self.memory[_TORQUE_ENABLE]) and not self.alert

    def read(self, address: int, length: int) -> bytes:
        """Registers, after the shaft moved on."""
        self.move()
        self.store(_PRESENT_POSITION, round(self.shaft) + self.load(_HOMING_OFFSET, 4), 4)
        return bytes(self.memory[address : address + length])

    def write(self, address: int, data: bytes) -> int:
        """Write registers; return the status error."""
        if address < _EEPROM_END and self.torque:
            return ERROR_ACCESS
        self.move()
        self.memory[address : address + len(data)] = data
        return 0

    def move(self) -> None:
        """Move the shaft towards its goal, as far as it gets since the last call."""
        now = time.monotonic()
        reach = self.speed * (now - self.moved_at_s)
        self.moved_at_s = now
        if self.torque:
            way = self.load(_GOAL_POSITION, 4) - self.load(_HOMING_OFFSET, 4) - self.shaft
            self.shaft += max(-reach, min(reach, way))


class DynamixelEmulator(EmulatedPort):
    """A bus of motors on a pseudo-terminal that `link` names."""

    def __init__(self, motors: list[EmulatedMotor], link: Path) -> None:
        super().__init__(link)
        self.motors = {motor.motor_id: motor for motor in motors}
        self._buffer = bytearray()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._buffer += self._receive(wait_s=0.05)
            while (found := self._next_packet()) is not None:
                if answer := self.answer(*found):
                    self._transmit(answer)

    def _next_packet(self) -> tuple[int, int, bytes] | None:
        """(id, instruction, parameters) of the next whole packet; drops broken ones."""
        while (start := self._buffer.find(HEADER)) >= 0:
            del self._buffer[:start]
            if len(self._buffer) < 7:
                return None
            end = 7 + int.from_bytes(self._buffer[5:7], "little")
            if len(self._buffer) < end:
                return None
            whole = bytes(self._buffer[:end])
            del self._buffer[:end]
            if crc16(whole[:-2]) == int.from_bytes(whole[-2:], "little"):
                body = whole[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
                return whole[4], body[0], body[1:]
        return None

    def answer(self, motor_id: int, instruction: int, parameters: bytes) -> bytes:
        """Status packets to one instruction packet; empty where none is due."""
        if instruction == SYNC_READ:
            address, length = _two_words(parameters)
            return b"".join(
                self._status(i, 0, m.read(address, length)) for i, m in self._listed(parameters[4:])
            )
        if instruction == SYNC_WRITE:
            self._sync_write(parameters)
            return b""
        if instruction == PING:
            found = self.motors.values() if motor_id == BROADCAST_ID else self._listed_motors([motor_id])
            return b"".join(self._status(m.motor_id, 0, m.read(_MODEL, 2) + b"\x2d") for m in found)
        motor = self.motors.get(motor_id)
        if motor is None:
            return b""
        if instruction == READ:
            return self._status(motor_id, 0, motor.read(*_two_words(parameters)))
        if instruction == WRITE:
            address = int.from_bytes(parameters[:2], "little")
            return self._status(motor_id, self._write(motor_id, address, parameters[2:]), b"")
        return b""

    def _sync_write(self, parameters: bytes) -> None:
        address, length = _two_words(parameters)
        records = parameters[4:]
        for at in range(0, len(records) - length, length + 1):
            self._write(records[at], address, records[at + 1 : at + 1 + length])

    def _write(self, motor_id: int, address: int, data: bytes) -> int:
        """Write to a motor and to those that shadow it; return the motor's own status error."""
        for motor in self.motors.values():
            if motor.memory[_SECONDARY_ID] == motor_id and motor.motor_id != motor_id:
                motor.write(address, data)
        motor = self.motors.get(motor_id)
        if motor is None:
            return 0
        error = motor.write(address, data)
        if address == _ID and not error:
            motor.motor_id = data[0]
            self.motors[motor.motor_id] = self.motors.pop(motor_id)
        return error

    def _listed(self, ids: bytes) -> list[tuple[int, EmulatedMotor]]:
        return [(motor.motor_id, motor) for motor in self._listed_motors(list(ids))]

    def _listed_motors(self, ids: list[int]) -> list[EmulatedMotor]:
        return [self.motors[motor_id] for motor_id in ids if motor_id in self.motors]

    def _status(self, motor_id: int, error: int, parameters: bytes) -> bytes:
        motor = self.motors.get(motor_id)
        alert = ALERT if motor is not None and motor.alert else 0
        return packet(motor_id, STATUS, bytes([error | alert]) + parameters)


def _two_words(parameters: bytes) -> tuple[int, int]:
    return int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")
