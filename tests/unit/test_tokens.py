"""The file of tokens, and the command that writes it."""

from __future__ import annotations

import hashlib
import json
import stat
from pathlib import Path

import pytest

from graderd.cli.app import run_app
from graderd.hal.errors import DeviceError
from graderd.tokens import Right, create_token, read_tokens, revoke_token


def test_only_the_hash_is_kept_and_the_file_is_private(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    token = create_token(path, "tablet", Right.COMMAND)
    assert len(token) >= 43
    assert token not in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    (kept,) = read_tokens(path)
    assert (kept.name, kept.right, kept.digest) == ("tablet", "command", hashlib.sha256(token.encode()).hexdigest())


def test_one_name_one_token_and_revoking_forgets_it(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    create_token(path, "tablet", Right.READ)
    create_token(path, "office", Right.READ)
    with pytest.raises(DeviceError, match="there is a token 'tablet'"):
        create_token(path, "tablet", Right.COMMAND)
    revoke_token(path, "tablet")
    assert [token.name for token in read_tokens(path)] == ["office"]
    with pytest.raises(DeviceError, match="there are: office"):
        revoke_token(path, "tablet")
    assert [found.name for found in tmp_path.iterdir()] == ["tokens"]


@pytest.mark.parametrize("name", ["", "A", "a b", "-a", "x" * 33, "a\nb", "über"])
def test_a_name_is_one_word_that_prints(tmp_path: Path, name: str) -> None:
    with pytest.raises(DeviceError, match="is no name"):
        create_token(tmp_path / "tokens", name, Right.READ)


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o610, 0o604, 0o602, 0o601])
def test_a_file_that_others_may_use_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "tokens"
    create_token(path, "tablet", Right.READ)
    path.chmod(mode)
    with pytest.raises(DeviceError, match=f"chmod 600 {path}"):
        read_tokens(path)


@pytest.mark.parametrize(
    "line", ["a-token-of-an-older-graderd", "tablet owner 2026 " + "0" * 64, "tablet read 2026 xyz"]
)
def test_a_line_of_another_kind_is_refused_and_not_repeated(tmp_path: Path, line: str) -> None:
    path = tmp_path / "tokens"
    path.touch(0o600)
    path.write_text(f"# a comment\n\n{line}\n")
    with pytest.raises(DeviceError) as refused:
        read_tokens(path)
    assert refused.value.where == f"tokens {path}:3"
    assert "older-graderd" not in str(refused.value)


def test_the_command_makes_lists_and_revokes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "graderd.toml"
    config.write_text(f'[api.tcp]\ntoken_file = "{tmp_path}/tokens"\n')
    by = ["--config", str(config), "--json"]
    assert run_app(["token", "create", "tablet", "--right", "command", *by]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["page"] == f"http://127.0.0.1:8431/#{made['token']}"
    assert read_tokens(tmp_path / "tokens")[0].digest == hashlib.sha256(made["token"].encode()).hexdigest()
    assert run_app(["token", "list", *by]) == 0
    listed = capsys.readouterr().out
    assert json.loads(listed)["tokens"][0]["right"] == "command"
    assert made["token"] not in listed
    assert run_app(["token", "create", "tablet", *by]) == 1
    assert "Revoke it first" in capsys.readouterr().err
    assert run_app(["token", "revoke", "tablet", *by]) == 0
    assert read_tokens(tmp_path / "tokens") == ()
