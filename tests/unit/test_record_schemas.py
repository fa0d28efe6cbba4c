"""Pictures, transforms and log lines follow Foxglove's schemas, field by field, as its own library has them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import foxglove.messages
import pytest

from graderd.record.layout import COLOR, DEPTH, LEVELS, LOG, PREVIEW, TRANSFORM, schema_of

ADDED_LATER = {"message_id", "lineage"}
"""Optional in Foxglove's JSON schemas; a recording's messages do not have them."""
DOUBLE, STRING, BYTES, FIXED32, UINT32, ENUM, MESSAGE = 1, 9, 12, 7, 13, 14, 11
"""FieldDescriptorProto.Type."""
TIME = ".google.protobuf.Timestamp"


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Numbers and values of a protobuf message; of its wire types only those that descriptors have."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at, value, shift = at + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    while at < len(data):
        key = varint()
        if key & 7 == 0:
            yield key >> 3, varint()
        else:
            assert key & 7 == 2
            length_n = varint()
            yield key >> 3, data[at : at + length_n]
            at += length_n


def all_of(data: bytes, number: int) -> list[Any]:
    return [value for found, value in fields(data) if found == number]


def messages_of(descriptor_set: bytes) -> dict[str, dict[str, tuple[int, str]]]:
    """Type and name of the type of every field, by the messages' full names."""
    found = {}
    for file in all_of(descriptor_set, 1):
        (package,) = all_of(file, 2)
        for message in all_of(file, 4):
            (name,) = all_of(message, 1)
            found[f".{package.decode()}.{name.decode()}"] = {
                all_of(field, 1)[0].decode(): (all_of(field, 5)[0], (all_of(field, 6) or [b""])[0].decode())
                for field in all_of(message, 2)
            }
    return found


def agree(schema: dict[str, Any], kind: int, name: str, messages: dict[str, Any]) -> bool:
    """Whether a property of a JSON schema is that field."""
    if kind == MESSAGE and name != TIME:
        same(schema, name, messages)
        return True
    if kind == ENUM:
        return name.startswith(f".{schema['title']}") or name.endswith("Level")
    return {
        (DOUBLE, ""): schema.get("type") == "number",
        (STRING, ""): schema == {"type": "string"},
        (BYTES, ""): (schema.get("type"), schema.get("contentEncoding")) == ("string", "base64"),
        (FIXED32, ""): (schema.get("type"), schema.get("minimum")) == ("integer", 0),
        (UINT32, ""): (schema.get("type"), schema.get("minimum")) == ("integer", 0),
        (MESSAGE, TIME): schema.get("title") == "time" and set(schema["properties"]) == {"sec", "nsec"},
    }[kind, name]


def same(schema: dict[str, Any], name: str, messages: dict[str, Any]) -> None:
    wanted = {field: told for field, told in messages[name].items() if field not in ADDED_LATER}
    assert schema["title"] == name.removeprefix(".")
    assert set(schema["properties"]) == set(schema["required"]) == set(wanted)
    for field, (kind, type_name) in wanted.items():
        assert agree(schema["properties"][field], kind, type_name, messages), (name, field)


@pytest.mark.parametrize("topic", [LOG, TRANSFORM, PREVIEW, COLOR, DEPTH])
def test_a_schema_is_foxgloves(topic: str) -> None:
    name, text = schema_of(topic)
    official = getattr(foxglove.messages, name.removeprefix("foxglove.")).get_schema()
    assert official.name == name
    same(json.loads(text), f".{name}", messages_of(official.data))


def test_levels_are_foxgloves() -> None:
    for level, number in LEVELS.items():
        assert int(getattr(foxglove.messages.LogLevel, level.title())) == number
