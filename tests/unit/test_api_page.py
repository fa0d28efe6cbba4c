"""The operator page as it is served: to anybody by a name of ours, whole, from this machine alone."""

from __future__ import annotations

import base64
import hashlib
import re
from importlib.resources import files
from pathlib import Path

import httpx
import pytest

from graderd.api.settings import TcpSettings
from harness.api_daemon import free_port, serving

WEB = Path(str(files("graderd.web")))
TEXTS = {
    path.name: path.read_text("utf-8") for path in WEB.iterdir() if path.suffix in (".html", ".css", ".js", ".json")
}


@pytest.mark.live
async def test_it_is_served_without_a_token_and_to_no_foreign_name(tmp_path: Path) -> None:
    tcp = TcpSettings(port_n=free_port(), token_file=tmp_path / "tokens")
    browser = httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False)
    async with serving(tmp_path, tcp=tcp), browser as client:
        index = await client.get("/")
        assert index.text == TEXTS["index.html"]
        loads = re.findall(r'(?:src|href)="(/[^"]*)"', index.text)
        loads += [f"/page/{name}" for name in TEXTS if name != "index.html"]
        for path in loads:
            answer = await client.get(path)
            assert answer.status_code == 200, path
            assert answer.text == TEXTS[path.removeprefix("/page/")]
            assert answer.headers["content-type"].startswith(("text/css", "text/javascript", "application/json"))
        assert (await client.head("/")).status_code == 200
        assert (await client.get("/", headers={"Host": "evil.example"})).status_code == 403
        assert (await client.post("/")).status_code == 401
        assert (await client.get("/page/../v1/status")).status_code == 401
        assert (await client.get("/page/none.js")).status_code == 404
        policy = index.headers["content-security-policy"]
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    for kind in ("script", "style"):
        (text,) = re.findall(rf"<{kind}>(.*?)</{kind}>", TEXTS["index.html"], re.DOTALL)
        assert f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" in policy


def test_what_stops_stands_before_everything_that_loads() -> None:
    index = TEXTS["index.html"]
    assert index.index('<form id="stop" method="post" action="/v1/stop">') < index.index("<script>")
    assert index.index("<script>") < index.index('rel="stylesheet"') < index.index('type="module"')


def test_it_is_light_and_takes_nothing_from_elsewhere() -> None:
    assert sum(len(text.encode()) for text in TEXTS.values()) < 300_000
    for name, text in TEXTS.items():
        assert re.findall(r"https?://|@import|@font-face|url\(", text) == [], name


def test_every_word_is_there_in_both_languages() -> None:
    sections = re.findall(r"^  (en|ko): \{(.*?)^  \},", TEXTS["texts.js"], re.DOTALL | re.MULTILINE)
    keys = {language: set(re.findall(r'(?:^|[\s,])"?([a-z_+-]+)"?: "', body)) for language, body in sections}
    assert keys["en"] == keys["ko"]
    used = set(re.findall(r'data-t="(\w+)"', TEXTS["index.html"]))
    used |= {key for name in TEXTS for key in re.findall(r'\bt\("([a-z_]+)"', TEXTS[name])}
    assert used <= keys["en"], used - keys["en"]
    assert len(used) > 60
