"""A recording played to clients: in its time or faster, paused, sent elsewhere, and never obeying anybody."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from graderd.api.port import ServiceError
from graderd.core.commands import Arm, Stop
from graderd.core.machine import Mode
from graderd.record.reader import Recording
from graderd.runtime.app.replay_server import NO_MACHINE, Player
from tests.replay.test_recordings import RECORDINGS
from tests.unit.test_replay import WORK, recorded


@asynccontextmanager
async def playing(player: Player) -> AsyncIterator[Player]:
    task = asyncio.create_task(player.run())
    try:
        async with asyncio.timeout(20):
            yield player
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_it_plays_what_was_and_stands_at_the_end(tmp_path: Path) -> None:
    modes = set()
    async with playing(Player(recorded(tmp_path), speed=100.0)) as player:
        while (status := await player.next_status(0.0)).time_s < WORK[-1].now_s:
            modes.add(status.mode)
    assert modes >= {Mode.DISARMED, Mode.MANUAL, Mode.AUTO}
    assert status.version


async def test_paused_it_stands_and_goes_where_it_is_sent(tmp_path: Path) -> None:
    async with playing(Player(recorded(tmp_path), speed=1.0)) as player:
        await player.next_status(0.0)
        assert (await player.service("replay.pause", {}))["paused"] is True
        found = await player.service("replay.seek", {"to_s": 3.0})
        assert found["at_s"] == pytest.approx(3.0, abs=0.03)
        stands = player.status().time_s
        for _ in range(20):
            await asyncio.sleep(0)
        assert player.status().time_s == stands
        await player.service("replay.seek", {"to_s": 0.5})
        assert player.status().time_s < stands
        await player.service("replay.play", {"speed": 50})
        assert (await player.next_status(0.0)).time_s > 0.0
        with pytest.raises(ServiceError, match="s long"):
            await player.service("replay.seek", {"to_s": 1e6})
        with pytest.raises(ServiceError, match="speed"):
            await player.service("replay.play", {"speed": 0})


async def test_nobody_is_obeyed(tmp_path: Path) -> None:
    player = Player(recorded(tmp_path))
    for reply in (await player.command(Arm(client="x")), player.stop(Stop())):
        assert not reply.accepted
        assert reply.message == NO_MACHINE


async def test_a_recording_of_the_grader_shows_its_status() -> None:
    player = Player(Recording(RECORDINGS[0]), from_s=8.0)
    async with playing(player):
        status = await player.next_status(0.0)
    assert status.decision.zone == "right"
    assert status.axes["rotation"].measured is not None
