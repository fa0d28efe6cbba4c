#!/bin/sh
# lifecycle.sh PACKAGE NEWER: the package's life in a guest that booted a clean root where apt has installed PACKAGE.
# Prints a line per step; ends at the first that fails.
set -eu
package=$1 newer=$2
step() { printf 'package: %s\n' "$*"; }
fail() { printf 'package: FAILED: %s\n' "$*"; journalctl -u graderd --no-pager -n 40 || true; exit 1; }
mode() { graderd status --json 2>/dev/null | python3 -c 'import json,sys; print(json.load(sys.stdin)["mode"])' || echo none; }
until_mode() { # MODE SECONDS
    for _ in $(seq "$2"); do [ "$(mode)" = "$1" ] && return 0; sleep 1; done
    fail "not $1 after $2 s but $(mode)"
}
# At low priority: unpacking takes the guest's one processor for seconds, and the simulated devices would miss theirs.
# Without the place of the socket, which is the script's knowledge, not the package's.
install() { env -u GRADERD_SOCKET nice -n 19 dpkg -i --force-unsafe-io "$1"; }
pid() { systemctl show --value -p MainPID graderd; }
policy() { # STATUS: what policy-rc.d says to whoever asks
    printf '#!/bin/sh\nexit %s\n' "$1" >/usr/sbin/policy-rc.d
    chmod 755 /usr/sbin/policy-rc.d
}
ready() {
    for _ in $(seq 60); do graderd arm >/dev/null 2>&1 && return 0; sleep 1; done
    fail "cannot be armed: $(graderd arm 2>&1)"
}

step "installed by apt in the clean root: $(dpkg-query -W graderd)"
[ "$(systemctl is-active graderd)" = inactive ] || fail "it was started without being asked to"
getent passwd graderd >/dev/null || fail "no user graderd"
[ "$(stat -c '%U:%G %a' /etc/graderd)" = "root:graderd 750" ] || fail "rights of /etc/graderd"
[ -r /usr/share/man/man1/graderd.1.gz ] && [ -r /usr/share/bash-completion/completions/graderd ] || fail "man, completion"
[ -z "$(systemd-analyze verify --man=no graderd.service 2>&1)" ] || fail "systemd-analyze verify"

# The guest has one slow processor for all of it: smaller pictures, more patience (conftest.py says why).
for setting in color_width_px=640 color_height_px=400 depth_width_px=424 depth_height_px=240 lease_s=3.0 \
    watchdog_s=0.6 goal_timeout_s=0.6 reply_timeout_s=0.8 max_age_s=0.8 feedback_timeout_s=0.8 \
    overrun_s=0.5; do
    sed -i "s/^#${setting%=*} = .*/${setting%=*} = ${setting#*=}/" /etc/graderd/graderd.toml
done
sed -i '/^\[camera\]/,/^\[camera.calibration\]/s/^#rate_hz = .*/rate_hz = 3.0/' /etc/graderd/graderd.toml
mkdir -p /etc/systemd/system/graderd.service.d
cp /usr/share/graderd/dropins/realtime.conf /etc/systemd/system/graderd.service.d/

# The daemon's socket is not where it usually is: whoever asks whether the machine moves must find it all the same.
sed -i 's|^#socket = .*|socket = "/run/graderd/elsewhere.sock"|' /etc/graderd/graderd.toml
grep -q elsewhere /etc/graderd/graderd.toml || fail "no api.socket in the configuration"
export GRADERD_SOCKET=/run/graderd/elsewhere.sock

step "asked for where policy-rc.d forbids it: not started"
export GRADERD_SIM=1
policy 101
install "$package" >/tmp/forbidden 2>&1 || fail "$(cat /tmp/forbidden)"
[ "$(systemctl is-active graderd)" = inactive ] || fail "started against policy-rc.d"
rm /usr/sbin/policy-rc.d

step "asked for: started at once on the simulated grader; no device of others is announced anew"
# Were every network interface announced anew, lo would be.
echo 'ACTION=="add", RUN+="/bin/sh -c '"'echo %p >>/run/announced'"'"' >/etc/udev/rules.d/99-hil.rules
udevadm control --reload
udevadm trigger --action=add --subsystem-match=net && udevadm settle
grep -q '/lo$' /run/announced || fail "the test does not see what is announced"
rm /run/announced
install "$package" >/dev/null
unset GRADERD_SIM
udevadm settle
[ ! -e /run/announced ] || fail "announced anew: $(cat /run/announced)"
rm /etc/udev/rules.d/99-hil.rules
until_mode disarmed 60
step "used: armed, blade turned"
for attempt in 1 2 3 4; do
    ready
    graderd manual >/dev/null 2>&1 || true
    graderd jog rotate =+10deg --timeout-s 100 >/dev/null && break
    [ "$attempt" != 4 ] || fail "jog"
done

step "an upgrade while armed is refused, and nothing has changed"
[ "$(mode)" = manual ] || ready
pid=$(pid)
if install "$newer" >/tmp/refused 2>&1; then fail "the upgrade went through while armed"; fi
grep -q armed /tmp/refused || fail "no reason given: $(cat /tmp/refused)"
[ "$(pid)" = "$pid" ] || fail "the daemon was restarted while armed"
[ "$(dpkg-query -W -f '${Version}' graderd)" != 99.0.0 ] || fail "the version changed"
graderd disarm >/dev/null
until_mode disarmed 10

step "a removal while armed is refused too, whatever its configuration says by now of the socket"
ready
sed -i 's|elsewhere|nowhere|' /etc/graderd/graderd.toml
if env -u GRADERD_SOCKET dpkg --remove graderd >/tmp/refused 2>&1; then fail "it was removed while armed"; fi
grep -q 'is armed' /tmp/refused || fail "no reason given: $(cat /tmp/refused)"
[ "$(pid)" = "$pid" ] || fail "the daemon was stopped while armed"
graderd disarm >/dev/null
until_mode disarmed 10
sed -i 's|nowhere|elsewhere|' /etc/graderd/graderd.toml

step "an upgrade when disarmed keeps configuration and calibration, migrates an old file with a backup, restarts"
# The newer package's format is one later: what stood in [yard] it wants in [rotation].
printf '# the grader of the yard\n[yard]\nzero_deg = 7.25\n' >>/etc/graderd/graderd.toml
echo keep >/var/lib/graderd/recordings/pass-1
format=$(sed -n 's/^version = //p' /etc/graderd/graderd.toml)
cp /etc/graderd/graderd.toml /tmp/before.toml
install "$newer" >/tmp/upgrade 2>&1 || fail "upgrade: $(tail -5 /tmp/upgrade)"
until_mode disarmed 60
[ "$(dpkg-query -W -f '${Version}' graderd)" = 99.0.0 ] || fail "version"
grep -q '^zero_deg = 7.25' /etc/graderd/graderd.toml || fail "calibration lost"
grep -q "^version = $((format + 1))" /etc/graderd/graderd.toml || fail "not migrated: $(cat /tmp/upgrade)"
grep -q '^# the grader of the yard' /etc/graderd/graderd.toml || fail "comments lost"
! grep -q '^\[yard\]' /etc/graderd/graderd.toml || fail "what was moved still stands"
cmp -s /tmp/before.toml /etc/graderd/graderd.toml.*.bak || fail "no backup of the former file"
grep -q -- --sim /etc/default/graderd || fail "the choice of --sim was lost"

step "purge leaves the recordings and nothing else"
dpkg --purge graderd >/tmp/purge 2>&1 || fail "purge: $(cat /tmp/purge)"
[ -f /var/lib/graderd/recordings/pass-1 ] || fail "the recording is gone"
rm -r /var/lib/graderd
left=$(find / -xdev -name '*graderd*' -not -path '/proc/*' -not -path '/sys/*' -not -path '/root/hil/*' -not -path '/run/hil-out/*' \
    -not -path '/var/log/*' -not -path '/var/cache/*' -not -path '/run/log/*' 2>/dev/null || true)
[ -z "$left" ] || fail "left behind: $left"
if getent passwd graderd >/dev/null || getent group graderd >/dev/null; then fail "user or group left behind"; fi
systemctl list-unit-files --no-pager | grep -q graderd && fail "unit left behind"
step "passed"
