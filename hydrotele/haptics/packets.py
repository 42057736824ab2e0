"""Packets between a haptic device and a machine: UDP, words of 8 bytes, little-endian.

The device's server sends a pose every period; the machine answers every pose with a wrench. Both
packets carry a sequence number and a send time; a packet that is older than the last accepted one
is dropped. The server draws a session number at its start, so that late packets of an earlier
session are recognised.

| word | pose packet (21 words) | word | wrench packet (12 words) |
| ---: | --- | ---: | --- |
| 0 | "HTPOSE01" | 0 | "HTWRCH01" |
| 1 | session | 1 | session that it answers, 0 to start one |
| 2 | sequence | 2 | sequence |
| 3 | send time, device's clock [ns] | 3 | send time, machine's clock [ns] |
| 4 | buttons, one per bit | 4 | sequence of the pose that it answers |
| 5 | sequence of the last accepted wrench, -1 for none | 5 | 1: forces on, 0: forces off |
| 6 | periods that the device has missed | 6-8 | force on the handle [N] |
| 7 | periods that started without the answer to the last pose | 9-11 | torque on it [N m] |
| 8-10 | position of the handle from its centre [m] | | |
| 11-14 | quaternion of its orientation, scalar first | | |
| 15, 16 | half range of travel [m], rotation [rad]; 0 rad: no rotation | | |
| 17, 18 | maximum force [N] and torque [N m] | | |
| 19 | period of the device [s] | | |
| 20 | 1: the device applies forces, 0: it currently cannot | | |

Words 0 to 7 of a pose and 0 to 5 of a wrench are signed integers, all others IEEE doubles. Axes: x
away from the user, y to the left, z up.
"""

from typing import NamedTuple

import numpy as np

POSE_MAGIC = int.from_bytes(b"HTPOSE01", "little")
WRENCH_MAGIC = int.from_bytes(b"HTWRCH01", "little")
POSE_WORDS, WRENCH_WORDS = 21, 12
# indices of words in both packets
MAGIC, SESSION, SEQUENCE, SENT = range(4)
# indices of words in a pose
BUTTONS, LAST_ACCEPTED, MISSED, UNANSWERED, POSITION = range(4, 9)
QUATERNION, TRAVEL, MAX_WRENCH, PERIOD, CAN_APPLY_FORCE = 11, 15, 17, 19, 20
# indices of words in a wrench
ANSWERED_POSE, FORCES_ON, WRENCH = range(4, 7)


class Packet(NamedTuple):
    """Memory of one packet with an integer and a real view.

    Attributes:
        integers: (n,) int64 view.
        reals: (n,) float64 view of the same memory.
    """

    integers: np.ndarray
    reals: np.ndarray

    @property
    def byte_view(self) -> memoryview:
        """Byte view of the packet, for sending and receiving."""
        return self.integers.data.cast("B")


def make_packet(words: int) -> Packet:
    """Create a packet of zeros.

    Args:
        words: length in words of 8 bytes.

    >>> p = make_packet(2)
    >>> p.reals[1] = 1.0
    >>> hex(int(p.integers[1]))
    '0x3ff0000000000000'
    """
    whole = np.zeros(words, "<i8")
    return Packet(whole, whole.view("<f8"))
