"""One message description of the whole machine, for other CAN tools.

The layouts in ``firmware_profiles`` describe one actuator each, at its first address, and all actuators share two
parameter groups: a tool that goes by the identifier knows only one of them, one that goes by the group takes all for
the same. Here every actuator of the configuration has messages of its own, under the identifiers that it really uses.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import cantools.database
from cantools.database.can import Database

from graderd.drivers.electrak.profile import load_profile, read_layout
from graderd.drivers.j1939.ids import Pgn, make_id
from graderd.hal.settings import ElectrakSettings

_PRIORITY: Final = 6
_EXTENDED: Final = 1
"""Value of the attribute VFrameFormat: to be told by the whole identifier, not by the parameter group (3)."""


def machine_database(actuators: Mapping[str, ElectrakSettings], source: int) -> Database:
    """``ACM_<name>`` and ``AFM_<name>`` of each actuator; ``source`` is our own address, from which the ACM come."""
    messages = []
    parts = None
    for name, settings in actuators.items():
        layout = load_profile(settings.profile).layout
        parts = cantools.database.load_string(read_layout(layout), database_format="dbc")
        assert isinstance(parts, Database)  # for the type checker: it is a DBC file
        for message in parts.messages:
            if message.name == "ACM":
                message.frame_id = make_id(_PRIORITY, Pgn.PROPRIETARY_A, source, settings.address_n)
                message.comment = f"Actuator control message to {name}, address {settings.address_n}."
            else:
                message.frame_id = make_id(_PRIORITY, Pgn.PROPRIETARY_A2, settings.address_n)
                message.comment = f"Actuator feedback message of {name}, address {settings.address_n}."
            message.name = f"{message.name}_{name}"
            if message.dbc is not None:
                message.dbc.attributes["VFrameFormat"].value = _EXTENDED
            messages.append(message)
    if parts is None:
        return Database()
    return Database(messages=messages, nodes=parts.nodes, dbc_specifics=parts.dbc)
