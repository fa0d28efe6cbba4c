"""What is in a recording: its channels, their schemas, and how values become messages and values again.

A recording is an MCAP file (docs/adr/0080). Ours are JSON messages with JSON Schema made from the very classes the tick
works with; pictures, transforms and log lines follow Foxglove's well-known schemas. Numbers are written so that they
read back bit for bit: the tick of a recording is the tick again.

``log_time`` is nanoseconds of the wall clock as it stood when the file was begun, moved on by the monotonic clock: a
stepped wall clock does not make a recording jump.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import pickle
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from enum import Enum
from functools import cache, lru_cache
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, NamedTuple, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from typing_extensions import TypedDict

from graderd.core import (
    attitude,
    axes,
    commands,
    gate,
    lift_pair,
    machine,
    plausibility,
    readiness,
    rule,
    soil,
    tick,
)
from graderd.core.axes import AXES
from graderd.core.faults import monitor
from graderd.core.faults.monitor import ActiveFault, FaultRow
from graderd.core.readiness import Requirement
from graderd.core.soil import SoilObservation
from graderd.core.tick import AxisTick, Controller, Sensed, Tick, TickSettings
from graderd.hal import fault, reading
from graderd.hal.camera import Intrinsics

SENSED: Final = "/sensed"
TICK: Final = "/tick"
MEMORY: Final = "/memory"
MARK: Final = "/mark"
GAP: Final = "/gap"
"""In no file as the daemon writes it: readers put it where something cannot be read, and an export keeps it."""
LOG: Final = "/log"
TRANSFORM: Final = "/tf"
PREVIEW: Final = "/camera/preview"
FRAME: Final = "/camera/frame"
COLOR: Final = "/camera/color"
DEPTH: Final = "/camera/depth"
WIRE: Final = "/wire/"
"""With the wire's name."""
WIRES: Final = ("can", "servo")

CHANNELS: Final = (SENSED, TICK, MEMORY, MARK, LOG, TRANSFORM, PREVIEW, *(WIRE + name for name in WIRES))
"""Of every run and incident."""
FRAME_CHANNELS: Final = (FRAME, COLOR, DEPTH)
"""Of raw frames."""

METADATA: Final = "graderd"
CHANNEL_NAMES: Final = "graderd.channels"
"""Which topic each channel's number is, in the head."""
CONFIG: Final = "config.json"

PREFIX: Final = "graderd-"
SUFFIX: Final = ".mcap"
INCIDENT_SUFFIX: Final = ".incident.mcap"
FRAMES_SUFFIX: Final = ".frames.mcap"


class Message(NamedTuple):
    """One message on its way into a file."""

    topic: str
    log_ns: int
    data: bytes


Whole = Annotated[int, Field(ge=0, le=2**64 - 1)]
"""A count, a place in a file or nanoseconds, as MCAP has them."""


def clock(log_ns: int) -> str:
    """A moment of a recording for people: UTC, to the millisecond."""
    return datetime.fromtimestamp(log_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3]


class Mark(BaseModel):
    """Something about the recording itself, or a word that somebody put there.

    ``note``: a client's. ``incident``: why the black box keeps this. ``lost``: ``lost_n`` values were not recorded
    because the disk or the processor did not keep up; what follows begins with a new ``/memory``. ``ended``: why
    recording ended here, where it did not end with the daemon.
    """

    model_config = ConfigDict(frozen=True)

    kind: Literal["note", "incident", "lost", "ended"]
    text: str = ""
    client: str = ""
    lost_n: Whole = 0


class Gap(BaseModel):
    """A part of a file that cannot be read, between what can.

    ``chunk_n``: which chunk of the file it is, or begins with, from 1. ``from_ns`` and ``to_ns``: when the last message
    before it and the first one after it were logged; None where there is none, or nobody knows.
    """

    model_config = ConfigDict(frozen=True)

    file: Annotated[str, Field(min_length=1)]
    chunk_n: Whole
    first_byte_n: Whole
    bytes_n: Whole
    from_ns: Whole | None = None
    to_ns: Whole | None = None

    @property
    def duration_s(self) -> float | None:
        """How long it lasts; None: unknown."""
        return None if self.from_ns is None or self.to_ns is None else (self.to_ns - self.from_ns) / 1e9

    def __str__(self) -> str:
        """For people."""
        ends = [
            f"{word} {clock(at_ns)}"
            for word, at_ns in (("after", self.from_ns), ("before", self.to_ns))
            if at_ns is not None
        ]
        lasts = "" if self.duration_s is None else f" ({self.duration_s:.2f} s)"
        where = f"chunk {self.chunk_n}, bytes {self.first_byte_n} to {self.first_byte_n + self.bytes_n}"
        what = f"what was logged {' and '.join(ends)}{lasts}" if ends else "all there was"
        return f"{self.file}: damaged in {where}: {what} cannot be read"


class Unreadable(BaseModel):
    """Messages of one channel that are not as graderd writes them: they are left out, what is around them is read.

    ``topic``: empty where it is a whole file that lies beside a recording. ``first_ns``: when the first of them was
    logged. ``cause``: of the first. ``version``: in the file's head.
    """

    model_config = ConfigDict(frozen=True)

    file: str
    topic: str
    first_ns: int | None
    messages_n: int
    cause: str
    version: str = ""

    def __str__(self) -> str:
        """For people."""
        if self.first_ns is None:
            return f"{self.file}: {self.cause}; it is left out. The rest is read without it"
        more = f" and {self.messages_n - 1} more" if self.messages_n > 1 else ""
        own = f"; graderd {self.version} reads its own" if self.version else ""
        return (
            f"{self.file}: {self.topic} at {clock(self.first_ns)}{more}: not as graderd writes it ({self.cause}), and "
            f"left out. Another version or another program wrote it{own}"
        )


class Wire(BaseModel):
    """What crossed a wire, a line each, as ``graderd can dump`` and ``graderd rotation dump`` read it: every byte."""

    model_config = ConfigDict(frozen=True)

    lines: tuple[str, ...]


class Memory(BaseModel):
    """What the tick keeps in mind after the tick before: with it a replay can begin here.

    ``controller``: a :class:`~graderd.core.tick.Controller` without its settings, pickled, base64; read by
    :func:`controller_of` only, which makes nothing but values of ``graderd.core`` and ``graderd.hal``.
    """

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64", frozen=True)

    now_s: float
    controller: bytes


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One raw picture of ``/camera/color`` and ``/camera/depth``, with everything it was judged by and what came of it.

    ``angle_deg``, ``angle_age_s``, ``height_mm``, ``slope_deg``, ``pitch_deg``: the blade at that moment.
    ``judged_s``: when it was judged, on the clock of ``capture_s``. ``every_n``: of so many frames, one is kept.
    """

    capture_s: float
    judged_s: float
    angle_deg: float
    angle_age_s: float
    observation: SoilObservation
    every_n: int
    color_number: int = -1
    depth_number: int = -1
    height_mm: float | None = None
    slope_deg: float | None = None
    pitch_deg: float | None = None
    color_intrinsics: Intrinsics | None = None
    depth_intrinsics: Intrinsics | None = None
    metadata: dict[str, float] = field(default_factory=dict)


# ---- values as messages ----------------------------------------------------------------------------------------------

_LOSSLESS: Final = ConfigDict(ser_json_inf_nan="strings")
_typed: Any = TypedDict
_AxisRecord = _typed("_AxisRecord", get_type_hints(AxisTick), total=False)
_RequirementRecord = _typed("_RequirementRecord", get_type_hints(Requirement))
_RowRecord = _typed("_RowRecord", get_type_hints(FaultRow) | {"axes": tuple[str, ...]})
_FaultRecord = _typed("_FaultRecord", get_type_hints(ActiveFault) | {"row": _RowRecord})
_TICK_FIELDS: Final = get_type_hints(Tick) | {
    "axes": dict.__class_getitem__((str, _AxisRecord)),
    "faults": tuple.__class_getitem__((_FaultRecord, ...)),
    "readiness": tuple.__class_getitem__((_RequirementRecord, ...)),
}
_TickRecord = _typed("_TickRecord", _TICK_FIELDS, total=False)


class _Codec:
    """Values of a class as JSON and back. What is None is left out: every field that may be is None by default. An
    adapter's configuration is not taken by a dataclass itself, but by the items of a list."""

    def __init__(self, kind: Any) -> None:
        self._adapter: TypeAdapter[list[Any]] = TypeAdapter(list[kind], config=_LOSSLESS)

    def bytes_of(self, value: Any) -> bytes:
        return self._adapter.dump_json([value], exclude_none=True)[1:-1]

    def value_of(self, data: bytes) -> Any:
        (found,) = self._adapter.validate_json(b"[%b]" % data)
        return found

    def schema(self) -> dict[str, Any]:
        whole = self._adapter.json_schema(mode="serialization")
        return plain_schema(whole["items"], whole.get("$defs", {}))


_SENSED: Final = _Codec(Sensed)
_TICK: Final = _Codec(_TickRecord)
_FRAME: Final = _Codec(FrameRecord)


def sensed_bytes(sensed: Sensed) -> bytes:
    """What a tick knew, as JSON that reads back bit for bit."""
    return _SENSED.bytes_of(sensed)


def sensed_of(data: bytes) -> Sensed:
    """The reverse.

    Raises:
        ValueError: it is no such message.
    """
    found: Sensed = _SENSED.value_of(data)
    return found


def tick_bytes(told: Tick) -> bytes:
    """What a tick decided, as JSON; equal bytes are equal ticks."""
    plain = told._asdict()
    plain["axes"] = {name: axis._asdict() for name, axis in told.axes.items()}
    plain["faults"] = tuple(
        {"name": f.name, "row": _row(f.row), "detail": f.detail, "since_s": f.since_s, "present": f.present}
        for f in told.faults
    )
    plain["readiness"] = tuple(requirement._asdict() for requirement in told.readiness)
    return _TICK.bytes_of(plain)


def tick_of(data: bytes) -> Tick:
    """The reverse.

    Raises:
        ValueError: it is no such message.
    """
    plain = _TICK.value_of(data)
    try:
        plain["axes"] = MappingProxyType({name: AxisTick(**axis) for name, axis in plain["axes"].items()})
        plain["faults"] = tuple(
            ActiveFault(**fault | {"row": FaultRow(**fault["row"] | {"axes": frozenset(fault["row"]["axes"])})})
            for fault in plain["faults"]
        )
        plain["readiness"] = tuple(Requirement(**requirement) for requirement in plain["readiness"])
        return Tick(**plain)
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"no tick: {error}") from None


@lru_cache(maxsize=64)
def _row(row: FaultRow) -> dict[str, Any]:
    """In one order everywhere: that of a set differs from process to process."""
    return {**asdict(row), "axes": tuple(sorted(row.axes))}


def frame_bytes(record: FrameRecord) -> bytes:
    """A raw picture's circumstances as JSON."""
    return _FRAME.bytes_of(record)


def frame_of(data: bytes) -> FrameRecord:
    """The reverse.

    Raises:
        ValueError: it is no such message.
    """
    found: FrameRecord = _FRAME.value_of(data)
    return found


# ---- the tick's memory -----------------------------------------------------------------------------------------------


def memory_of(controller: Controller, settings: TickSettings) -> bytes:
    """Everything the controller keeps in mind, without the settings it goes by."""
    out = io.BytesIO()
    out.write(_fingerprint())
    _MemoryWriter(out, settings).dump(controller)
    return out.getvalue()


def controller_of(memory: bytes, settings: TickSettings) -> Controller:
    """A controller that goes on from there, by these settings, which may be others.

    Raises:
        ValueError: nothing that today's tick could go on from: another version's, or no memory at all.
    """
    mark = _fingerprint()
    if not memory.startswith(mark):
        raise ValueError("the tick's memory is of another version of the tick")
    try:
        found = _MemoryReader(io.BytesIO(memory[len(mark) :]), settings).load()
    except Exception as error:  # whatever a damaged or foreign pickle leads to
        raise ValueError(f"the tick's memory cannot be read ({error})") from error
    if not isinstance(found, Controller) or _shape(found) != _shape(Controller(settings)):
        raise ValueError("the tick's memory is of another version of the tick")
    return found


_KEPT_IN_MEMORY: Final = (
    attitude, axes, commands, gate, lift_pair, machine, monitor, plausibility, readiness, rule, soil, tick, fault,
    reading,
)  # fmt: skip
"""Where the classes are whose values a controller keeps."""


@cache
def _fingerprint() -> bytes:
    """Of the fields of those classes: they are kept by their place, so a memory with others is none."""
    fields_of = {
        f"{module.__name__}.{name}": [*getattr(kind, "__dataclass_fields__", getattr(kind, "_fields", ()))]
        for module in _KEPT_IN_MEMORY
        for name, kind in vars(module).items()
        if isinstance(kind, type)
    }
    return hashlib.sha256(json.dumps(fields_of, sort_keys=True).encode()).hexdigest()[:16].encode()


def _parts_of(settings: TickSettings) -> dict[str, Any]:
    """What of the settings the controller's parts hold on to, by name."""
    return {
        "settings": settings,
        "lift_pair": settings.lift_pair,
        "figures": settings.figures,
        **{f"motion.{axis}": figures for axis, figures in settings.motion.items()},
    }


def _proxy(mapping: dict[Any, Any]) -> Mapping[Any, Any]:
    """A class that pickle knows no name for."""
    return MappingProxyType(mapping)


class _MemoryWriter(pickle.Pickler):
    def __init__(self, out: io.BytesIO, settings: TickSettings) -> None:
        super().__init__(out, protocol=4)
        self._names = {id(part): name for name, part in _parts_of(settings).items()}

    def persistent_id(self, value: Any) -> str | None:
        return self._names.get(id(value))

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, MappingProxyType):
            return _proxy, (dict(value),)
        if isinstance(value, Enum):  # by its value in every Python: 3.11.0 to 3.11.3 would write a call of getattr
            return type(value), (value.value,)
        return NotImplemented


class _MemoryReader(pickle.Unpickler):
    """Knows the value classes of core and hal, and no function of anybody."""

    _ALLOWED: Final[Mapping[tuple[str, str], Any]] = {
        (__name__, "_proxy"): _proxy,
        ("builtins", "frozenset"): frozenset,
        ("builtins", "set"): set,
    }

    def __init__(self, data: io.BytesIO, settings: TickSettings) -> None:
        super().__init__(data)
        self._parts = _parts_of(settings)

    def persistent_load(self, name: Any) -> Any:
        return self._parts[name]

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in self._ALLOWED:
            return self._ALLOWED[module, name]
        if module.startswith(("graderd.core.", "graderd.hal.")) and "." not in name:
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__ == module:
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is no part of the tick's memory")


def _shape(value: Any) -> Any:
    """Names of what an object of ours keeps, to its depth; values of slots and tuples are whole by their making."""
    held = value if isinstance(value, dict) else getattr(value, "__dict__", {})
    deeper = held if held is not value else {key: inner for key, inner in held.items() if hasattr(inner, "__dict__")}
    return {name: _shape(inner) for name, inner in sorted(deeper.items())}


# ---- schemas ---------------------------------------------------------------------------------------------------------

_KEPT: Final = ("title", "description", "type", "minimum", "maximum", "contentEncoding")


def plain_schema(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """A schema without references and alternatives, which Foxglove's reader of schemas does not follow: an optional
    value is described as what it is where it is there, alternatives as an object with the properties of all."""
    if "$ref" in schema:
        return plain_schema(definitions[schema["$ref"].removeprefix("#/$defs/")], definitions)
    options = [o for o in schema.get("anyOf", schema.get("oneOf", ())) if o.get("type") != "null"]
    if options:
        plain = [plain_schema(option, definitions) for option in options]
        if len({p["type"] for p in plain}) > 1 or plain[0]["type"] != "object":
            return plain[0]
        properties = {name: inner for option in plain for name, inner in option.get("properties", {}).items()}
        return {"type": "object", "properties": properties}
    found = {key: schema[key] for key in _KEPT if key in schema}
    if "type" not in found:
        found["type"] = "string"
    if found["type"] == "object":
        inner = schema.get("properties", {})
        found["properties"] = {name: plain_schema(value, definitions) for name, value in inner.items()}
        each = schema.get("additionalProperties")
        if isinstance(each, dict) and "type" not in each:  # a mapping of axes
            found["properties"] = {axis: plain_schema(each, definitions) for axis in AXES}
        found["required"] = [name for name in schema.get("required", ()) if "default" not in inner[name]]
    if found["type"] == "array":
        items = schema.get("items") or next(iter(schema.get("prefixItems", ())), {"type": "string"})
        found["items"] = plain_schema(items, definitions)
    return found


_TIME: Final = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}


def _object(title: str, **properties: Any) -> dict[str, Any]:
    """A schema of Foxglove's, all of whose properties are required."""
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


_NUMBER: Final = {"type": "number"}
_TEXT: Final = {"type": "string"}
IMAGE_SCHEMA: Final = _object(
    "foxglove.CompressedImage",
    timestamp=_TIME,
    frame_id=_TEXT,
    data={"type": "string", "contentEncoding": "base64"},
    format=_TEXT,
)
TRANSFORM_SCHEMA: Final = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER),
    rotation=_object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
)
LEVELS: Final = {"UNKNOWN": 0, "DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "FATAL": 5}
LOG_SCHEMA: Final = _object(
    "foxglove.Log",
    timestamp=_TIME,
    level={
        "title": "foxglove.LogLevel",
        "oneOf": [{"title": title, "const": number} for title, number in LEVELS.items()],
    },
    message=_TEXT,
    name=_TEXT,
    file=_TEXT,
    line={"type": "integer", "minimum": 0},
)
_FOXGLOVE: Final = {
    LOG: LOG_SCHEMA,
    TRANSFORM: TRANSFORM_SCHEMA,
    PREVIEW: IMAGE_SCHEMA,
    COLOR: IMAGE_SCHEMA,
    DEPTH: IMAGE_SCHEMA,
}


@cache
def schema_of(topic: str) -> tuple[str, bytes]:
    """Name and JSON Schema of a channel's messages."""
    if topic in _FOXGLOVE:
        schema = _FOXGLOVE[topic]
        return str(schema["title"]), json.dumps(schema).encode()
    match topic:
        case _ if topic.startswith(WIRE):
            name, schema = "graderd.Wire", plain_schema(Wire.model_json_schema(), {})
        case "/sensed":
            name, schema = "graderd.Sensed", _SENSED.schema()
        case "/tick":
            name, schema = "graderd.Tick", _TICK.schema()
        case "/camera/frame":
            name, schema = "graderd.Frame", _FRAME.schema()
        case "/memory":
            name, schema = "graderd.Memory", plain_schema(Memory.model_json_schema(mode="serialization"), {})
        case "/mark":
            name, schema = "graderd.Mark", plain_schema(Mark.model_json_schema(), {})
        case "/gap":
            name, schema = "graderd.Gap", plain_schema(Gap.model_json_schema(), {})
        case _:
            raise ValueError(f"no channel {topic}")
    return name, json.dumps(schema).encode()


def _stamp(log_ns: int) -> str:
    return f'{{"sec":{log_ns // 1_000_000_000},"nsec":{log_ns % 1_000_000_000}}}'


def image_message(topic: str, log_ns: int, data_base64: str, image_format: str) -> Message:
    """A picture by Foxglove's schema."""
    head = f'{{"timestamp":{_stamp(log_ns)},"frame_id":"camera","format":"{image_format}","data":"'
    return Message(topic, log_ns, f'{head}{data_base64}"}}'.encode())


def log_message(log_ns: int, level: int, name: str, text: str) -> Message:
    """A log line by Foxglove's schema."""
    told = json.dumps({"level": level, "message": text, "name": name, "file": "", "line": 0})
    return Message(LOG, log_ns, f'{{"timestamp":{_stamp(log_ns)},{told[1:]}'.encode())


def blade_message(log_ns: int, angle_deg: float, height_mm: float | None) -> Message:
    """The blade in the vehicle's frame: turned about its axis, at its height."""
    half = math.radians(angle_deg) / 2.0
    at_m, quaternion = (0.0, 0.0, (height_mm or 0.0) / 1000.0), (0.0, 0.0, math.sin(half), math.cos(half))
    return transform_message(log_ns, "vehicle", "blade", at_m, quaternion)


def transform_message(
    log_ns: int,
    parent: str,
    child: str,
    at_m: tuple[float, float, float],
    quaternion: tuple[float, float, float, float],
) -> Message:
    """Where one frame of reference stands in another; the quaternion is x, y, z, w."""
    translation = dict(zip("xyz", at_m, strict=True))
    rotation = dict(zip("xyzw", quaternion, strict=True))
    told = json.dumps(
        {"parent_frame_id": parent, "child_frame_id": child, "translation": translation, "rotation": rotation}
    )
    return Message(TRANSFORM, log_ns, f'{{"timestamp":{_stamp(log_ns)},{told[1:]}'.encode())
