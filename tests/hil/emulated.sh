#!/bin/sh
# The installed package on a processor of another kind, emulated: daemon and rig come up, arm, turn, lift, disarm.
# Pictures are too slow there to be judged in time, so automatic operation is left out. Run by hil/arm64.py, as root.
set -eu
say() { echo "arm64: $*"; }
fail() { say "FAILED: $*"; tail -5 /root/daemon.log; exit 1; }

mkdir -p /run/graderd
graderd run --sim >/root/daemon.log 2>&1 &
daemon=$!
trap 'kill $daemon 2>/dev/null || true; wait $daemon 2>/dev/null || true' EXIT
tries=0
until graderd status --json 2>/dev/null | grep -q '"lifecycle": *"standby"'; do
    tries=$((tries + 1))
    [ $tries -lt 60 ] || fail "no daemon after a minute"
    sleep 1
done
say "daemon up on $(uname -m), $(/opt/graderd/bin/python --version), $(dpkg-query -W graderd)"
/opt/graderd/bin/python -I -c 'import cv2, numpy, pydantic, can, serial; print(f"arm64: OpenCV {cv2.__version__}, numpy {numpy.__version__}")'
graderd arm >/dev/null || fail "not armed"
graderd jog rotate +10deg || fail "the blade does not turn"
graderd jog height 20mm || fail "the lifts do not move"
graderd disarm >/dev/null || fail "not disarmed"
kill $daemon
wait $daemon || fail "the daemon did not end in order"
say "passed"
