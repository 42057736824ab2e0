"""Packets between a haptic device and a machine: UDP, words of 8 bytes, little-endian.

The device's server sends a pose every period, the machine answers every pose with a wrench. Both
carry a sequence number and the time of sending; what is older than what was taken before is
dropped. A session number, drawn when the server starts, tells a server that was started anew from
packets that come late.

| word | pose packet (21 words) | word | wrench packet (12 words) |
| ---: | --- | ---: | --- |
| 0 | "HTPOSE01" | 0 | "HTWRCH01" |
| 1 | session | 1 | session that it answers, 0 to open one |
| 2 | sequence | 2 | sequence |
| 3 | time of sending, device's clock [ns] | 3 | time of sending, machine's clock [ns] |
| 4 | buttons, one per bit | 4 | sequence of the pose that it answers |
| 5 | sequence of the last wrench taken, -1 for none | 5 | 1: forces on, 0: the device goes limp |
| 6 | periods that the device has missed | 6-8 | force on the handle [N] |
| 7 | periods that began without the answer to the last pose | 9-11 | torque on it [N m] |
| 8-10 | place of the handle from its centre [m] | | |
| 11-14 | quaternion of its orientation, scalar first | | |
| 15, 16 | travel either way [m], [rad]; 0 rad: no rotation | | |
| 17, 18 | largest force [N] and torque [N m] | | |
| 19 | period of the device [s] | | |
| 20 | 1: the device gives forces, 0: it cannot now | | |

Words 0 to 7 of a pose and 0 to 5 of a wrench are signed integers, all others IEEE doubles. Axes: x
away from the user, y to the left, z up.
"""

from typing import NamedTuple

import numpy as np

POSE_MAGIC = int.from_bytes(b"HTPOSE01", "little")
WRENCH_MAGIC = int.from_bytes(b"HTWRCH01", "little")
POSE_WORDS, WRENCH_WORDS = 21, 12
# words of both
MAGIC, SESSION, SEQUENCE, SENT = range(4)
# words of a pose
BUTTONS, TAKEN, MISSED, UNANSWERED, PLACE = range(4, 9)
QUATERNION, TRAVEL, MOST, PERIOD, ABLE = 11, 15, 17, 19, 20
# words of a wrench
ANSWERED, ON, WRENCH = range(4, 7)


class Packet(NamedTuple):
    """One packet in memory, seen in two ways.

    Attributes:
        whole: (n,) int64.
        real: (n,) float64, the same memory.
    """

    whole: np.ndarray
    real: np.ndarray

    @property
    def raw(self) -> memoryview:
        """The bytes, to send or to receive into."""
        return self.whole.data.cast("B")


def packet(words: int) -> Packet:
    """An empty packet.

    Args:
        words: its length.

    >>> p = packet(2)
    >>> p.real[1] = 1.0
    >>> hex(int(p.whole[1]))
    '0x3ff0000000000000'
    """
    whole = np.zeros(words, "<i8")
    return Packet(whole, whole.view("<f8"))
