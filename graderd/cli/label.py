"""``graderd label``: say where the soil lies on a site's own frames, so that they become a frame set with truth."""

from __future__ import annotations

import json as json_module
import secrets
import threading
from collections import Counter
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd.cli.console import CliError, ExitCode, Json, example, print_json, print_text
from graderd.cli.record import tell_lacking
from graderd.core.soil import Zone
from graderd.hal.errors import DeviceError, ProtocolError

if TYPE_CHECKING:
    from graderd.perception.frame_set import FrameSet

BODY_MOST_BYTES = 4096
JPEG_QUALITY = 85


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        epilog=example(
            "graderd label monday/frames",
            "graderd label graderd-20260102T030405Z-000.mcap --to site",
            "graderd label pictures/ --to site --config /etc/graderd/graderd.toml",
        )
    )
    def label(
        folder: Annotated[Path, typer.Argument(help="Frame set; or with --to a recording or a folder of pictures.")],
        to: Annotated[Path | None, typer.Option("--to", help="Make a frame set of the frames here first.")] = None,
        config: Annotated[
            Path | None, typer.Option(help="With --to, for pictures: configuration with the camera's calibration.")
        ] = None,
        blade_angle_deg: Annotated[
            float, typer.Option(min=-90, max=90, help="With --to, for pictures: the blade's angle on them.")
        ] = 0.0,
        port: Annotated[int, typer.Option(min=0, max=65535, help="Loopback port of the page; 0: any free one.")] = 0,
        json: Json = False,
    ) -> None:
        """Label frames on a page of this computer: left, center, right, even, none or unknown.

        The page shows each frame as the operator sees it, facing forward, without what graderd thinks of it. Every
        label is written to manifest.csv at once. `graderd classify FOLDER` then prints what the site's own figure is.
        """
        from graderd.perception.frame_set import FrameSet

        is_whole = to is None or make_frame_set(folder, to, config, blade_angle_deg)
        try:
            labels = Labels(FrameSet(to or folder))
        except DeviceError as error:
            remedy = error.remedy or "With --to, a recording or a folder of pictures becomes a frame set"
            raise CliError(error.where, error.cause, remedy, ExitCode.USAGE) from None
        with Page(labels, port) as page:
            if json:
                print_json({"event": "label_ready", "url": page.url, "frames_n": len(labels.ids)})
            else:
                print_text(f"{len(labels.ids)} frames: open {page.url} - 'done' on the page, or Ctrl-C, ends it")
            page.serve()
        counts = Counter(str(zone) for zone in labels.given.values() if zone is not None)
        if json:
            print_json({"event": "labelled", "folder": str(labels.folder), "labels": dict(sorted(counts.items()))})
        else:
            told = ", ".join(f"{count} {zone}" for zone, count in sorted(counts.items())) or "none"
            print_text(f"labelled: {told}. The site's own figure: graderd classify {labels.folder}")
        if not is_whole:
            raise typer.Exit(ExitCode.FAILED)


def make_frame_set(source: Path, folder: Path, config: Path | None, blade_angle_deg: float) -> bool:
    """A frame set of a recording's raw frames, or of a folder of pictures; whether all there was is in it."""
    if folder.exists():
        raise CliError(str(folder), "is there already", "name a folder that is not", ExitCode.USAGE)
    if source.suffix == ".mcap":
        from graderd.config import ConfigError
        from graderd.record.export import export_frames, gaps_of
        from graderd.record.reader import Recording

        recording = Recording(source)
        try:
            frames_n = export_frames(recording, folder)
        except ConfigError as error:
            raise CliError("", error.problems[0]) from None
        tell_lacking(gaps_of(recording), recording.unreadable)
        if frames_n == 0:
            raise CliError(str(source), "holds no raw frames", "record with graderd record start --raw full")
        return not recording.unreadable
    _from_pictures(source, folder, config, blade_angle_deg)
    return True


def _from_pictures(source: Path, folder: Path, config: Path | None, blade_angle_deg: float) -> None:
    from dataclasses import replace

    from graderd.config import load
    from graderd.hal.camera import EndOfFrames
    from graderd.perception.frame_set import Entry, FrameSetWriter, with_lens_of
    from graderd.runtime.app.frame_sources import open_camera, settings_for_path

    loaded = load(config)
    camera = open_camera(settings_for_path(source), real_time=False)
    camera.open()
    writer, number = None, 0
    while True:
        try:
            frame = camera.read(1.0)
        except EndOfFrames:
            return
        height, width = frame.color_bgr.shape[:2]
        if frame.color_intrinsics is None:
            lens = loaded.camera.calibration.color.intrinsics().scaled(width, height)
            frame = replace(frame, color_intrinsics=lens)
        if writer is None:
            calibration = with_lens_of(frame, loaded.camera.calibration)
            writer = FrameSetWriter(folder, calibration, loaded.blade, with_depth=frame.depth_mm is not None)
        writer.add(Entry(f"{number:05d}", None, blade_angle_deg), frame)
        number += 1


class Labels:
    """The frames of a set, their pictures, and the labels given so far."""

    def __init__(self, frames: FrameSet) -> None:
        from graderd.perception import PerceptionSettings
        from graderd.perception.annotate import image_right_is_left
        from graderd.perception.classifier import make_classifier

        self.folder = frames.folder
        self.ids = [entry.id for entry in frames.entries]
        self.given: dict[str, Zone | None] = {entry.id: entry.label for entry in frames.entries}
        self.mirrored = image_right_is_left(frames.calibration.mounting)
        self._frames = frames
        self._entries = {entry.id: entry for entry in frames.entries}
        self._drawer = make_classifier(PerceptionSettings(), frames.calibration, frames.blade, live=False)
        self._lock = threading.Lock()

    def picture(self, id_: str) -> bytes:
        """The frame with the thirds outlined, and nothing of what is thought of it.

        Raises:
            KeyError: no such frame.
            DeviceError: its files are missing or damaged.
        """
        import cv2

        from graderd.core.soil import SoilObservation

        entry = self._entries[id_]
        with self._lock:
            frame = self._frames.frame(entry)
            unseen = SoilObservation(0.0, Zone.UNKNOWN, 0.0, "", blade_angle_deg=entry.blade_angle_deg)
            picture: Any = self._drawer.annotate(frame, unseen, labels=False)
        if self.mirrored:
            picture = cv2.flip(picture, 1)
        ok, data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))
        if not ok:
            raise ProtocolError(str(self.folder), f"frame {id_} cannot be shown")
        return data.tobytes()

    def set(self, id_: str, label: Zone | None) -> None:
        """Give a frame a label, or take it away; written at once.

        Raises:
            KeyError: no such frame.
            OSError: the manifest cannot be written.
        """
        from graderd.perception.frame_set import write_label

        with self._lock:
            if id_ not in self.given:
                raise KeyError(id_)
            write_label(self.folder, id_, label)
            self.given[id_] = label


class Page:
    """The page on loopback; who has its address may label. Used as ``with Page(...) as page: page.serve()``."""

    def __init__(self, labels: Labels, port: int) -> None:
        self._secret = secrets.token_urlsafe(12)
        self._server = ThreadingHTTPServer(("127.0.0.1", port), _handler(labels, f"/{self._secret}/", self.end))
        self._server.daemon_threads = True

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/{self._secret}/"

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.server_close()

    def serve(self) -> None:
        """Until it is done, or Ctrl-C."""
        try:
            self._server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            return

    def end(self) -> None:
        """From any thread."""
        threading.Thread(target=self._server.shutdown, daemon=True).start()


def _handler(labels: Labels, base: str, end: Callable[[], None]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self._path()
            if path == "":
                self._answer(HTTPStatus.OK, "text/html; charset=utf-8", PAGE.encode())
            elif path == "frames":
                self._json({"frames": [[id_, labels.given[id_] or ""] for id_ in labels.ids], "zones": list(Zone)})
            elif path is not None and path.startswith("picture/"):
                try:
                    self._answer(HTTPStatus.OK, "image/jpeg", labels.picture(path.removeprefix("picture/")))
                except KeyError:
                    self._refuse(HTTPStatus.NOT_FOUND, "no such frame")
                except DeviceError as error:
                    self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
            else:
                self._refuse(HTTPStatus.NOT_FOUND, "nothing is here")

        def do_POST(self) -> None:
            path = self._path()
            if path == "done":
                self._json({"done": True})
                end()
                return
            try:
                length_n = int(self.headers.get("Content-Length", "0"))
                if path != "label" or not 0 < length_n <= BODY_MOST_BYTES:
                    raise ValueError("a label is an object with id and label")
                asked = json_module.loads(self.rfile.read(length_n))
                labels.set(asked["id"], Zone(asked["label"]) if asked["label"] else None)
            except (ValueError, KeyError, TypeError) as error:
                self._refuse(HTTPStatus.BAD_REQUEST, f"no label: {error}")
            except OSError as error:
                self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"{error.filename}: {error.strerror}")
            else:
                self._json({"labelled": True})

        def _path(self) -> str | None:
            return self.path.removeprefix(base) if self.path.startswith(base) else None

        def _json(self, value: Any) -> None:
            self._answer(HTTPStatus.OK, "application/json", json_module.dumps(value).encode())

        def _refuse(self, status: HTTPStatus, why: str) -> None:
            self._answer(status, "application/json", json_module.dumps({"error": why}).encode())

        def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            """The command's output is its own."""

    return Handler


PAGE = """<!doctype html><html lang=en><meta charset=utf-8><title>graderd label</title><style>
body{font:16px/1.4 system-ui,sans-serif;max-width:1100px;margin:1em auto;padding:0 1em;color:#202124}
img{width:100%;background:#eee;border-radius:4px}
button{font:inherit;padding:.5em 1em;margin:.2em;border:1px solid #9aa0a6;border-radius:4px;background:#fff}
button.on{background:#202124;color:#fff}
.sides{display:flex;justify-content:space-between;color:#5f6368}#error{color:#c8403a}
</style>
<p><b id=name></b> <span id=progress></span> <span id=error></span></p>
<div class=sides><span>operator's left</span><span>operator's right</span></div>
<img id=picture alt=frame>
<p id=buttons></p>
<p>Where does the soil lie in front of the blade? Keys: <b>l</b>eft <b>c</b>enter <b>r</b>ight <b>e</b>ven <b>n</b>one
<b>u</b>nknown, <b>x</b> takes the label away, arrows go back and on. A label goes on to the next frame.
<button onclick="fetch('done',{method:'POST'}).then(()=>document.body.textContent='Done.')">done</button></p>
<script>
let frames=[],zones=[],at=0;const by=id=>document.getElementById(id);
function show(){if(!frames.length)return;const[id,label]=frames[at];by('name').textContent=id;
by('progress').textContent=`${at+1} of ${frames.length}, ${frames.filter(f=>f[1]).length} labelled`;
by('picture').src='picture/'+encodeURIComponent(id);
for(const b of by('buttons').children)b.className=b.textContent===label?'on':''}
function go(step){at=Math.min(Math.max(at+step,0),frames.length-1);show()}
async function give(label){const frame=frames[at];const answer=await fetch('label',{method:'POST',
body:JSON.stringify({id:frame[0],label})});by('error').textContent=answer.ok?'':(await answer.json()).error;
if(answer.ok){frame[1]=label;if(label)go(1);show()}}
fetch('frames').then(a=>a.json()).then(told=>{frames=told.frames;zones=told.zones;
for(const zone of zones){const b=document.createElement('button');b.textContent=zone;b.onclick=()=>give(zone);
by('buttons').append(b)}
at=Math.max(frames.findIndex(f=>!f[1]),0);show()});
addEventListener('keydown',e=>{if(e.ctrlKey||e.metaKey||e.altKey)return;
if(e.key==='ArrowLeft')go(-1);else if(e.key==='ArrowRight')go(1);else if(e.key==='x')give('');
else{const zone=zones.find(z=>z[0]===e.key);if(zone)give(zone)}});
</script></html>"""
