"""How commands ask a person, and how a file answers in the person's place.

Every question has a key. ``graderd setup --answers`` gives answers by key, so that a question more or less never makes
an answer meant for one the consent to another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import typer

from graderd.cli.console import CliError, ExitCode, print_text

T = TypeVar("T")
YES = ("y", "yes")


class Answers:
    """Answers by key: lines ``KEY = ANSWER``, ``#`` begins a comment. A key that stands there several times answers as
    often, one after the other; its last answer holds for all that follow, but for consents.

    Raises:
        CliError: a line is no such line.
    """

    def __init__(self, lines: Iterable[str], where: str) -> None:
        self.where = where
        self._left: dict[str, list[str]] = {}
        for number, line in enumerate(lines, start=1):
            text = line.strip()
            if not text or text.startswith("#"):
                continue
            key, equals, answer = (part.strip() for part in text.partition("="))
            if not equals or not key:
                cause = f"line {number} is not KEY = ANSWER: {text[:60]!r}"
                raise CliError(where, cause, "'graderd setup --questions' lists the keys", ExitCode.USAGE)
            self._left.setdefault(key, []).append(answer)

    def take(self, key: str) -> str | None:
        """The next answer to this question; None: there is none."""
        left = self._left.get(key)
        if not left:
            return None
        return left.pop(0) if len(left) > 1 else left[0]

    def consent(self, key: str) -> str | None:
        """As :meth:`take`, and each consent is used up: what it allowed once is not allowed again."""
        left = self._left.get(key)
        return left.pop(0) if left else None


_answers: ContextVar[Answers | None] = ContextVar("answers", default=None)


@contextmanager
def answered_by(answers: Answers | None) -> Iterator[None]:
    """Within the block, questions are answered by these; None: by the person."""
    token = _answers.set(answers)
    try:
        yield
    finally:
        _answers.reset(token)


def ask(key: str, question: str, parse: Callable[[str], T], default: str = "") -> T:
    """Ask until ``parse`` takes the answer; what it raises as ``ValueError`` is shown as the reason. An empty answer
    is the ``default``.

    Raises:
        CliError: nobody there to ask, or the file's answer is none.
    """
    answers = _answers.get()
    while True:
        if answers is None:
            try:
                text = str(typer.prompt(question, default=default, show_default=bool(default))).strip()
            except typer.Abort as abort:
                _interrupted(abort)
                raise CliError(key, "cancelled; nothing was changed", "Do it again") from None
        else:
            text = answers.take(key) or default
            print_text(f"{question}: {text}")
        try:
            return parse(text)
        except ValueError as error:
            if answers is not None:
                raise CliError(key, f"{answers.where}: {error}", f"Give '{key} = ...'", ExitCode.USAGE) from None
            print_text(f"{error}")


def one_of(*choices: str) -> Callable[[str], str]:
    """For :func:`ask`: one of these words, in any case."""

    def parse(text: str) -> str:
        if text.lower() not in choices:
            raise ValueError(f"{text!r} is none of these: {', '.join(choices)}")
        return text.lower()

    return parse


def agree(key: str, question: str, remedy: str = "Do it again") -> None:
    """Ask for consent, and go on with a clear yes only: not with Enter, not with another word.

    Raises:
        CliError: no, or nobody there to ask.
    """
    if not agreed(key, question):
        raise CliError(key, "cancelled; nothing was changed", remedy)


def agreed(key: str, question: str) -> bool:
    """Whether the person says yes; whoever is not there does not."""
    answers = _answers.get()
    if answers is None:
        try:
            return bool(typer.confirm(question, default=False))
        except typer.Abort as abort:
            _interrupted(abort)
            return False
    said = (answers.consent(key) or "").lower()
    print_text(f"{question} [y/N]: {said}")
    return said in YES


def _interrupted(abort: typer.Abort) -> None:
    """Ctrl-C at a question is Ctrl-C; the end of the input is none.

    Raises:
        KeyboardInterrupt: it was Ctrl-C.
    """
    if isinstance(abort.__context__, KeyboardInterrupt):
        raise KeyboardInterrupt from None


def numbered(rows: Sequence[tuple[str, str]]) -> str:
    """Things to choose from, a line each: ``1  NAME  what it is``."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join(f"  {number}  {name.ljust(width)}  {what}" for number, (name, what) in enumerate(rows, start=1))


def choice(names: Sequence[str], *more: str) -> Callable[[str], str]:
    """For :func:`ask`: a number of :func:`numbered`, a name of it, or one of ``more``."""

    def parse(text: str) -> str:
        if text.isdecimal() and 1 <= int(text) <= len(names):
            return names[int(text) - 1]
        if text in names or text in more:
            return text
        told = f"a number from 1 to {len(names)}" if names else "a name"
        raise ValueError(f"{text!r} is neither {told} nor {' nor '.join(more) or 'one of the names'}")

    return parse
