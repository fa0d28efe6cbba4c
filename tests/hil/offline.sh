#!/bin/sh
# offline.sh whole PACKAGE | all PACKAGE NEWER: the package in a root that nothing has booted, where apt has installed it,
# as an image builder or a rescue system has it. Upgrades that fail and succeed, a downgrade, full disks, planted names, a
# replaced Python, purge. NEWER has another format of the configuration. Leaves PACKAGE installed. Needs to mount.
set -eu
what=$1 package=$2 newer=${3:-}
python=/opt/graderd/bin/python
config=/etc/graderd/graderd.toml
step() { printf 'offline: %s\n' "$*"; }
fail() { printf 'offline: FAILED: %s\n' "$*"; exit 1; }
install() { dpkg -i --force-unsafe-io "$1" >/tmp/said 2>&1; }
version() { dpkg-query -W -f '${db:Status-Status} ${Version}' graderd; }
own=$(dpkg-deb -f "$package" Version)

# Installed, complete to the last file, working on this system's Python, with byte code for it and for no other.
whole() {
    [ "$(version)" = "installed $1" ] || fail "it is $(version), not installed $1"
    [ -z "$(dpkg --audit)" ] || fail "$(dpkg --audit)"
    dpkg --verify graderd | grep -v '^missing.*/usr/share/\(doc\|man\)' >/tmp/verify || true
    [ ! -s /tmp/verify ] || fail "files differ from the package: $(head -3 /tmp/verify)"
    graderd --help >/dev/null || fail "graderd does not start"
    $python -I -c 'import cv2, numpy, pydantic, can, serial, graderd.runtime.app' || fail "what it depends on is not whole"
    tag=$($python -I -c 'import sys; print(sys.implementation.cache_tag)')
    [ -z "$(find /opt/graderd -name '*.pyc' ! -name "*.$tag.pyc")" ] || fail "byte code of another Python"
    sources=$(find /opt/graderd/lib/common "/opt/graderd/lib/python$(python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])')" -name '*.py' | wc -l)
    codes=$(find /opt/graderd -name '*.pyc' | wc -l)
    [ "$sources" = "$codes" ] && [ "$codes" -gt 500 ] || fail "byte code: $codes of $sources files"
}
format() { # which format of the configuration the program knows; from its byte code, which nobody compares with the source
    $python -I -c 'from graderd.config import Config; print(Config().version)'
}
former_configuration() {
    cp /usr/share/graderd/graderd.toml $config
    printf '# the grader of the yard\n' >>$config
}

step "installed: $(version), $($python --version)"
whole "$own"
[ "$what" = all ] || exit 0
own_format=$(format)

step "configuration: root's to write, the group's to read"
[ "$(stat -c '%U:%G %a' /etc/graderd)" = "root:graderd 750" ] || fail "rights of /etc/graderd: $(stat -c '%U:%G %a' /etc/graderd)"
[ "$(stat -c '%U:%G %a' $config)" = "root:graderd 640" ] || fail "rights of $config: $(stat -c '%U:%G %a' $config)"

step "full disk: the upgrade fails and leaves the old version whole, byte code and all"
former_configuration
cp $config /tmp/former.toml
size_kib=$(du -sk /opt/graderd | cut -f 1)
mount -t tmpfs -o "size=$((size_kib + 40000))k" tmpfs /mnt
cp -a /opt/graderd /mnt/ && mount --bind /mnt /opt
if install "$newer"; then fail "no failure on a full disk"; fi
grep -q 'No space left' /tmp/said || fail "it failed otherwise: $(cat /tmp/said)"
whole "$own"
umount /opt && umount /mnt
cmp $config /tmp/former.toml || fail "configuration changed"

step "full disk under the configuration: installed all the same, the former file as it was, the reason told"
mkdir /tmp/etc && cp -a /etc/graderd/. /tmp/etc
mount -t tmpfs -o size=64k,mode=750,gid="$(getent group graderd | cut -d : -f 3)" tmpfs /etc/graderd
cp -a /tmp/etc/. /etc/graderd
cat /dev/zero >/etc/graderd/filler 2>/dev/null || true
install "$newer" || fail "half-configured by a full disk: $(tail -5 /tmp/said)"
cmp $config /tmp/former.toml || fail "configuration lost on a full disk"
grep -q 'not started with it' /tmp/said || fail "nothing told: $(cat /tmp/said)"
umount /etc/graderd && rm -r /tmp/etc
install "$package" || fail "$(tail -5 /tmp/said)"

step "names planted by the group in a directory that was once its own: root follows none"
chmod 0770 /etc/graderd
useradd --no-create-home --gid graderd planter
for name in .graderd.toml.new .graderd.toml.tmp adapters.new $(seq -f 'graderd.toml.%.0f.bak' 3); do
    setpriv --reuid=planter --regid=graderd --clear-groups ln -s /root/planted "/etc/graderd/$name"
done
day=$(date -u +%Y%m%d)
setpriv --reuid=planter --regid=graderd --clear-groups /bin/sh -c "
    for hour in \$(seq -w 0 23); do for minute in \$(seq -w 0 59); do for second in 00 10 20 30 40 50; do
        ln -s /root/planted /etc/graderd/graderd.toml.$day-\$hour\$minute\$second.bak
    done; done; done"
install "$newer" || fail "upgrade: $(tail -5 /tmp/said)"
whole 99.0.0
[ ! -e /root/planted ] || fail "root wrote where a planted name sent it"
[ -z "$(find /etc/graderd -type l)" ] || fail "planted links are left"
[ "$(stat -c '%U:%G %a' /etc/graderd)" = "root:graderd 750" ] || fail "rights of /etc/graderd after the upgrade"
if setpriv --reuid=planter --regid=graderd --clear-groups touch /etc/graderd/name 2>/dev/null; then fail "the group can write there"; fi
userdel planter

step "upgraded: migrated with a backup; the byte code is the new files'"
[ "$(format)" = $((own_format + 1)) ] || fail "stale byte code: format $(format)"
grep -q "^version = $((own_format + 1))" $config || fail "not migrated: $(cat /tmp/said)"
backup=$(echo /etc/graderd/graderd.toml.*.bak)
cmp "$backup" /tmp/former.toml || fail "the backup is not the former file"

step "downgrade: whole, not started with a configuration it cannot use, the backup named"
install "$package" || fail "half-configured for a newer configuration: $(tail -5 /tmp/said)"
whole "$own"
[ "$(format)" = "$own_format" ] || fail "stale byte code: format $(format)"
grep -q "^version = $((own_format + 1))" $config || fail "the newer configuration was changed"
grep -q "cp $backup $config" /tmp/said || fail "the backup is not named: $(cat /tmp/said)"
cp "$backup" $config
graderd config check $config >/dev/null || fail "the named backup cannot be used"

step "a Python that was replaced: byte code is made anew"
find /opt/graderd -name __pycache__ -prune -exec rm -r {} +
dpkg-trigger --by-package=python3-minimal /usr/bin/python3
dpkg --configure -a >/tmp/said 2>&1 || fail "trigger: $(cat /tmp/said)"
whole "$own"

step "remove keeps the configuration, purge nothing"
dpkg --remove graderd >/tmp/said 2>&1 || fail "remove: $(cat /tmp/said)"
[ -e $config ] && [ ! -e /opt/graderd ] || fail "remove: configuration gone, or files left"
if grep -q warning: /tmp/said; then fail "remove: $(cat /tmp/said)"; fi
dpkg --purge graderd >/tmp/said 2>&1 || fail "purge: $(cat /tmp/said)"
left=$(find / -xdev -name '*graderd*' -not -path '/root/hil/*' -not -path '/proc/*' -not -path '/var/log/*' -not -path '/var/cache/*')
[ -z "$left" ] || fail "left behind: $left"
if getent passwd graderd >/dev/null || getent group graderd >/dev/null; then fail "user or group left behind"; fi

install "$package" || fail "it does not install again: $(tail -5 /tmp/said)"
whole "$own"
step "passed"
