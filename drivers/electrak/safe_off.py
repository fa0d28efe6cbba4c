"""The last words on the bus: motion disabled for every actuator, from a process that has nothing else left."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from graderd.drivers.electrak.codec import Control, ElectrakCodec
from graderd.drivers.j1939.can_port import READY_S, PortFullError, PortLostError, open_port
from graderd.drivers.j1939.ids import Frame, Pgn, make_id
from graderd.drivers.j1939.link import name_from
from graderd.hal.errors import DeviceLostError
from graderd.hal.settings import CanSettings

REPEATS_N: Final = 4
_GAP_S: Final = 0.02
_ANSWER_S: Final = 0.3
_CLOSE_LINGER_S: Final = 0.05


def safe_off(settings: CanSettings, addresses: Sequence[int]) -> int:
    """Send motion-disable to ``addresses`` several times and return how many messages went out.

    Takes about 0.15 s, where the adapter boots first up to 3 s.

    For the guard that runs after the daemon died: it opens the bus anew, claims our address and does not wait the
    250 ms that J1939-81 asks for, because a stop is not to wait; Electraks take control messages from any address.

    Raises:
        DeviceMissingError: the bus cannot be opened.
        DeviceLostError: it was lost before a single round was complete.
    """
    port = open_port(settings)
    source = settings.source_address_n
    # a disabled message for any model: position, limit and speed are within every model's range and do not matter
    data = ElectrakCodec("electrak_hd").encode_control(Control(0.0, 1.0, 20.0, motion_enable=False))
    sent_n = 0
    try:
        ready = port.wait_ready(_ANSWER_S)
        while True:
            port.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, source), name_from(settings).to_bytes()))
            for _ in range(REPEATS_N):
                for address in addresses:
                    try:
                        port.send(Frame(make_id(3, Pgn.PROPRIETARY_A, source, address), data))
                        sent_n += 1
                    except PortFullError:
                        pass  # the next round tries again
                time.sleep(_GAP_S)
            time.sleep(_CLOSE_LINGER_S)
            if ready or not (ready := port.wait_ready(READY_S)):
                break  # what an adapter was given that only now says it is open, it has lost: once more
    except PortLostError as error:
        if sent_n < len(addresses):
            raise DeviceLostError(f"CAN {settings.channel}", error.detail, "Cut the actuators' supply") from error
    finally:
        port.close()
    return sent_n
