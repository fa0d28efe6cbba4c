#!/bin/sh
# users.sh PACKAGE NEWER: daemon, operator (of the group) and stranger on the installed package, in a root that nothing has
# booted: what each is told and may do. The daemon runs as its unit has it, on the simulated grader. NEWER has another
# format of the configuration. Leaves PACKAGE installed. The same on a checkout: tests/fault/test_three_users.py.
set -eu
package=$1 newer=$2
config=/etc/graderd/graderd.toml
unit=/usr/lib/systemd/system/graderd.service
daemon='' rig=''
trap 'for one in $daemon $rig; do kill "$one" 2>/dev/null || true; done' EXIT
step() { printf 'users: %s\n' "$*"; }
fail() { printf 'users: FAILED: %s\n' "$*"; cat /tmp/daemon.log 2>/dev/null || true; exit 1; }
of_unit() { sed -n "s/^$1=//p" $unit; }
as() { # USER COMMAND...: with what a login gives
    user=$1
    shift
    setpriv --reuid="$user" --regid="$user" --init-groups --no-new-privs --reset-env "$@"
}
told() { # STATUS TEXT USER COMMAND...: it ends with that status, and in one line that has TEXT ("": whatever it says)
    status=$1 text=$2
    shift 2
    found=0
    as "$@" >/tmp/out 2>/tmp/err </dev/null || found=$?
    [ "$found" = "$status" ] || fail "$*: status $found, not $status: $(cat /tmp/out /tmp/err)"
    if grep -q Traceback /tmp/out /tmp/err; then fail "$*: $(cat /tmp/err)"; fi
    [ -z "$text" ] || { [ "$(wc -l </tmp/err)" = 1 ] && grep -q -- "$text" /tmp/err; } || fail "$*: not '$text' in a line: $(cat /tmp/err)"
}
readable() { # the daemon still reads the configuration, and it still is root's
    [ "$(stat -c '%U:%G %a' $config)" = "root:graderd 640" ] || fail "rights of $config: $(stat -c '%U:%G %a' $config)"
    told 0 "" graderd graderd config check $config
}
service() { # as the unit starts it, but for ARGUMENT...
    (
        umask "$(of_unit UMask)"
        exec setpriv --reuid=graderd --regid=graderd --init-groups --no-new-privs --reset-env \
            env STATE_DIRECTORY=/var/lib/graderd RUNTIME_DIRECTORY=/run/graderd graderd run --config $config "$@"
    ) >/tmp/daemon.log 2>&1 </dev/null &
    daemon=$!
}
until_status() { # TEXT: in the status as the operator has it
    for _ in $(seq 120); do
        if as oper graderd status --json 2>/dev/null | grep -q "$1"; then return 0; fi
        kill -0 "$daemon" || fail "the daemon ended"
        sleep 0.5
    done
    fail "no $1 in $(as oper graderd status --json 2>&1)"
}
patiently() { # COMMAND...: a busy machine may hold itself, or disarm, under way; then once more, four times at most
    for _ in 1 2 3 4 5; do
        if "$@" >/tmp/out 2>&1 </dev/null; then return 0; fi
        as oper graderd disarm >/dev/null 2>&1 || true
        sleep 1
    done
    fail "$*: $(cat /tmp/out)"
}
pose() { told "$1" "$2" "$3" graderd calibrate camera --pose 0.9,0.05,0.6,30,1,-1 --yes; }

cp -p $config /tmp/installed.toml
useradd --create-home --user-group --groups graderd oper
useradd --create-home --user-group strange
install -d -m "$(of_unit RuntimeDirectoryMode)" -o graderd -g graderd /run/graderd
install -d -m "$(of_unit StateDirectoryMode)" -o graderd -g graderd /var/lib/graderd

step "install: nobody but root writes the configuration"
for user in graderd oper strange; do
    told 1 "Permission denied" $user touch /etc/graderd/planted
    if as $user sh -c "echo >>$config" 2>/dev/null; then fail "$user writes $config"; fi
done
readable

step "config: the daemon and an operator read it"
for user in graderd oper; do
    told 0 "" $user graderd config check
    told 0 "" $user graderd config show
done
told 2 "Permission denied" strange graderd config check
told 2 "Permission denied" strange graderd config show

step "run and status: one daemon, and who may ask it"
service --sim
until_status '"mode": *"disarmed"'
told 2 "Permission denied" strange graderd run --sim --config $config
as graderd env STATE_DIRECTORY=/var/lib/graderd graderd run --sim --config $config 2>/tmp/err && fail "two daemons"
grep -q 'another daemon' /tmp/err || fail "$(cat /tmp/err)"
told 0 "" graderd graderd status
told 0 "" oper graderd status
told 1 "graderd: " strange graderd status

step "calibrate: whoever cannot write the result moves nothing, and nothing is left behind"
until_status '"frames_per_s": *[1-9]'
for user in graderd oper strange; do pose 1 "graderd: " $user && readable; done
told 1 "graderd: " oper graderd calibrate camera --yes --angles-deg=-15,0,15
told 1 "graderd: " strange graderd calibrate camera --yes --angles-deg=-15,0,15
until_status '"mode": *"disarmed"'
patiently graderd calibrate camera --yes --angles-deg=-15,0,15
readable
[ -z "$(find /var/lib/graderd -name 'calibration-*')" ] || fail "pictures stay: $(find /var/lib/graderd)"

step "preset and the rest: an operator commands, a stranger does not"
for words in preset "preset transport" arm manual "jog rotate +2deg" stop reset disarm; do
    # shellcheck disable=SC2086
    told 1 "graderd: " strange graderd $words
done
works() {
    for words in preset arm manual "jog rotate +2deg" stop reset; do
        # shellcheck disable=SC2086
        as oper graderd $words || return 1
    done
}
patiently works
told 1 "graderd: " oper graderd preset nowhere
kill $daemon && wait $daemon || fail "the daemon's end"

step "guard: acts on what the daemon last ran with; whoever may not says so"
as graderd graderd rig --dir /run/graderd/rig >/dev/null 2>&1 </dev/null &
rig=$!
for _ in $(seq 100); do [ ! -e /run/graderd/rig/rig.json ] || break && sleep 0.2; done
service --rig-dir /run/graderd/rig
until_status '"lifecycle": *"standby"'
kill -KILL $daemon && wait $daemon 2>/dev/null || true
cp -p $config /tmp/keep.toml
for spoil in "chmod 600 $config" "rm $config"; do
    $spoil
    as graderd env STATE_DIRECTORY=/var/lib/graderd graderd guard --config $config 2>/tmp/err || fail "guard: $(cat /tmp/err)"
    grep -q '"failed": \[\]' /tmp/err || fail "guard: $(cat /tmp/err)"
    cp -p /tmp/keep.toml $config
done
as strange graderd guard 2>/tmp/err && fail "a stranger's guard"
grep -q 'Permission denied' /tmp/err && ! grep -q Traceback /tmp/err || fail "a stranger's guard: $(cat /tmp/err)"
kill $rig && wait $rig || true

step "upgrade: root's, and the daemon reads what it leaves"
for user in graderd oper strange; do
    told 2 "sudo" $user /opt/graderd/bin/python -P -m graderd.config.migrate $config
    if as $user dpkg -i "$newer" >/dev/null 2>&1; then fail "$user upgrades"; fi
    readable
done
dpkg -i --force-unsafe-io "$newer" >/tmp/out 2>&1 || fail "upgrade: $(tail -5 /tmp/out)"
readable
for backup in "$config".*.bak; do # the last upgrade's, and one of each calibration
    [ "$(stat -c '%U:%G %a' "$backup")" = "root:graderd 640" ] || fail "rights of $backup: $(stat -c '%U:%G %a' "$backup")"
done
cmp -s "$backup" /tmp/keep.toml || fail "the last backup is not what stood there before the upgrade"

cp -p /tmp/installed.toml $config
rm "$config".*.bak
dpkg -i --force-unsafe-io "$package" >/tmp/out 2>&1 || fail "$(tail -5 /tmp/out)"
userdel --remove oper 2>/dev/null
userdel --remove strange 2>/dev/null
rm -r /var/lib/graderd /run/graderd
step "passed"
