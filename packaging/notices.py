"""The package's ``copyright`` in Debian's machine-readable format: our licence, and those of all that is bundled.

What stands there about a dependency is what its wheel says of itself: name, version, licence and address from the
metadata, the text from its licence files. Texts that every Debian system has are not repeated but named, as Debian's
policy asks (12.5); the files themselves stay where the wheel has them, in its dist-info folder.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from email.message import Message
from email.parser import Parser
from pathlib import Path, PurePosixPath

HEAD = """\
Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/
Upstream-Name: graderd
Source: https://localhost/graderd
Comment: Below /opt/graderd/lib stands, beside graderd itself, what it depends on: the wheels that requirements.lock
 names, unpacked and otherwise unchanged. Each has a paragraph of its own, made from its own licence files.

Files: *
Copyright: graderd contributors
License: Apache-2.0
"""
APACHE = """\
License: Apache-2.0
 On Debian systems the text is in /usr/share/common-licenses/Apache-2.0.
"""

# Texts of /usr/share/common-licenses: name there, how the text begins and how it ends.
COMMON = (
    ("Apache-2.0", r"Apache License\s+Version 2\.0, January 2004", r"END OF TERMS AND CONDITIONS"),
    ("GPL-2", r"GNU GENERAL PUBLIC LICENSE\s+Version 2, June 1991", r"END OF TERMS AND CONDITIONS"),
    ("GPL-3", r"GNU GENERAL PUBLIC LICENSE\s+Version 3, 29 June 2007", r"END OF TERMS AND CONDITIONS"),
    ("LGPL-2", r"GNU LIBRARY GENERAL PUBLIC LICENSE\s+Version 2, June 1991", r"END OF TERMS AND CONDITIONS"),
    ("LGPL-2.1", r"GNU LESSER GENERAL PUBLIC LICENSE\s+Version 2\.1, February 1999", r"END OF TERMS AND CONDITIONS"),
    (
        "LGPL-3",
        r"GNU LESSER GENERAL PUBLIC LICENSE\s+Version 3, 29 June 2007",
        r"permanent authorization for you to choose that version for the\s+Library\.",
    ),
    (
        "MPL-2.0",
        r"Mozilla Public License Version 2\.0\s+=+\s+1\. Definitions",
        r"Incompatible With Secondary Licenses.{0,200}",
    ),
)
LICENCE_FILE = re.compile(r"licen[cs]e|copying|notice", re.IGNORECASE)
COPYRIGHT_LINE = re.compile(
    r"^\W*(?:portions )?copyright\b.*\d{4}.*$|^\W*\(c\) .*\d{4}.*$", re.IGNORECASE | re.MULTILINE
)


def copyright_file(wheels: Mapping[str, Iterable[Path]], place_of: Mapping[Path, str]) -> str:
    """The whole file, for the wheels of each Python; ``place_of`` says below which folder a wheel is unpacked.

    Raises:
        LookupError: a wheel says nothing of its licence.
    """
    parts = [HEAD]
    places: dict[str, list[str]] = {}
    texts: dict[str, str] = {}
    for wheel in sorted({wheel for files in wheels.values() for wheel in files}):
        with zipfile.ZipFile(wheel) as archive:
            text = _paragraph(archive, wheel.name)
            texts.setdefault(text, wheel.name)
            places.setdefault(text, []).extend(f"{place_of[wheel]}/{top}" for top in _tops(archive))
    for text in sorted(texts, key=lambda text: texts[text].lower()):
        parts.append("Files: " + "\n ".join(sorted(set(places[text]))) + "\n" + text)
    return "\n".join([*parts, APACHE])


def _tops(archive: zipfile.ZipFile) -> Iterator[str]:
    """What a wheel puts side by side, as patterns."""
    found: dict[str, bool] = {}
    for name in archive.namelist():
        path = PurePosixPath(name)
        if path.parts[0].endswith(".data"):
            if len(path.parts) < 3 or path.parts[1] not in ("purelib", "platlib"):
                continue
            path = PurePosixPath(*path.parts[2:])
        found[path.parts[0]] = found.get(path.parts[0], False) or len(path.parts) > 1
    return (f"{top}/*" if is_folder else top for top, is_folder in sorted(found.items()))


def _paragraph(archive: zipfile.ZipFile, wheel: str) -> str:
    """All but the files: copyright, licence, text, where it comes from."""
    metadata = next(name for name in archive.namelist() if re.fullmatch(r"[^/]+\.dist-info/METADATA", name))
    said = Parser().parsestr(archive.read(metadata).decode("utf-8"), headersonly=True)
    folder = metadata.removesuffix("METADATA")
    texts = {
        name.removeprefix(folder): archive.read(name).decode("utf-8", "replace")
        for name in sorted(archive.namelist())
        if name.startswith(folder) and LICENCE_FILE.search(PurePosixPath(name).name)
    }
    licence = _short_name(said)
    if not licence and not texts:
        raise LookupError(f"{wheel} names no licence: it cannot be shipped before somebody has found out which it has")
    holders = list(dict.fromkeys(_holders(texts.values()))) or [said["Author"] or said["Author-email"] or said["Name"]]
    body = "\n\n".join(f"{name}:\n{_without_common(text).strip()}" for name, text in texts.items())
    body = body or f"The wheel has no licence file; its metadata says: {licence}."
    home = said["Home-page"] or next((url.rpartition(" ")[2] for url in said.get_all("Project-URL") or []), "")
    return (
        f"Copyright: {_folded(holders)}\n"
        f"License: {licence or 'as below'}\n{_indented(body)}\n"
        f"Comment: {said['Name']} {said['Version']}{f', {home}' if home else ''}\n"
    )


def _short_name(said: Message) -> str:
    """One line: the SPDX expression, else the licence field, else the classifiers; empty where there is none."""
    expression = said["License-Expression"]
    if expression:
        return str(expression)
    field = (said["License"] or "").strip()
    if field and "\n" not in field and len(field) < 60:
        return " ".join(field.split())
    prefix = "License :: "
    classifiers = [str(value).rpartition(" :: ")[2] for value in said.get_all("Classifier") or [] if prefix in value]
    return " and ".join(classifiers)


def _holders(texts: Iterable[str]) -> Iterator[str]:
    for text in texts:
        for line in COPYRIGHT_LINE.findall(_without_common(text)):
            yield " ".join(line.strip(" \t*#/;|").split())


def _without_common(text: str) -> str:
    for name, begin, end in COMMON:
        place = f"[The text is in /usr/share/common-licenses/{name} on Debian systems.]"
        text = re.sub(f"{begin}.*?{end}", place, text, flags=re.DOTALL)
    return text


def _folded(lines: Iterable[str]) -> str:
    return "\n ".join(lines)


def _indented(text: str) -> str:
    """As a field's further lines: none of them empty, none with a control character."""
    lines = (re.sub(r"[^\x20-\x7e\xa0-\U0010ffff]", " ", line).rstrip() for line in text.expandtabs().splitlines())
    return "\n".join(f" {line or '.'}" for line in lines)
