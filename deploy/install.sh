#!/bin/sh
# Puts mapquilt on a robot, brings it up to date, or takes it off again.  Run it as often as you like.
set -eu

usage() {
    cat <<'TEXT'
sudo deploy/install.sh [options]             install or update
sudo deploy/install.sh --uninstall [--purge] take it off again; --purge also removes settings and maps

  --keys DIR          put the robot's keys in place: DIR is what mapquilt fleet enroll made for it
  --robot ID          also start the service mapquilt@ID now and at every boot
  --wheelhouse DIR    take the packages from this directory instead of the network (deploy/wheelhouse.sh makes one)
  --root DIR          put everything below DIR instead of / (to look at it, or to build an image)

What goes where:
  /opt/mapquilt                               the program and its packages
  /usr/local/bin/mapquilt                     the command
  /etc/mapquilt/robot.toml                    settings; yours are never overwritten
  /etc/mapquilt/fleet                         keys, for root and the service only
  /etc/systemd/system/mapquilt@.service       the service
  /etc/udev/rules.d/90-mapquilt.rules         who may use the serial ports
  /etc/modules-load.d/mapquilt.conf           serial drivers, there before the first plug
  /usr/local/share                            TAB completion for bash, and the man page
TEXT
}

say() { printf 'mapquilt: %s\n' "$*"; }
stop() { printf 'mapquilt: %s\n' "$2" >&2; exit "$1"; }
folder() { # option path
    [ -d "$2" ] || stop 4 "$1 $2: no such directory"
    readlink -f -- "$2"
}

here=$(dirname "$(readlink -f -- "$0")")
source=${here%/*}
root='' robot='' wheelhouse='' keys='' action=install purge=no
while [ $# -gt 0 ]; do
    case $1 in
        --robot) robot=${2:?--robot needs an id}; shift ;;
        --wheelhouse) wheelhouse=$(folder "$1" "${2:?--wheelhouse needs a directory}"); shift ;;
        --keys) keys=$(folder "$1" "${2:?--keys needs a directory}"); shift ;;
        --root) root=$(readlink -m -- "${2:?--root needs a directory}"); shift ;;
        --uninstall) action=uninstall ;;
        --purge) purge=yes ;;
        -h | --help) usage; exit 0 ;;
        *) usage >&2; stop 2 "unknown option $1" ;;
    esac
    shift
done
case $robot in *[!a-z0-9_-]* | [_-]*) stop 2 "--robot '$robot': use a-z, 0-9, '-' and '_', first a letter or digit" ;; esac

home=$root/opt/mapquilt
before=$home.before
settings=$root/etc/mapquilt
group=mapquilt-keys
command=$root/usr/local/bin/mapquilt
unit=$root/etc/systemd/system/mapquilt@.service
rules=$root/etc/udev/rules.d/90-mapquilt.rules
drivers=$root/etc/modules-load.d/mapquilt.conf
completion=$root/usr/local/share/bash-completion/completions/mapquilt
page=$root/usr/local/share/man/man1/mapquilt.1

# Commands for the running system: not when the files go somewhere else.
live() { [ -z "$root" ] && command -v "$1" >/dev/null 2>&1; }
systemd_runs() { live systemctl && [ -d /run/systemd/system ]; }

check() {
    [ -n "$root" ] || [ "$(id -u)" = 0 ] || stop 3 "this needs root: sudo $0"
    [ -z "$wheelhouse" ] || ls "$wheelhouse"/*.whl >/dev/null 2>&1 || stop 4 "$wheelhouse holds no .whl files; make it with: deploy/wheelhouse.sh $wheelhouse"
    [ -z "$keys" ] || [ -f "$keys/fleet.key" ] || stop 4 "$keys holds no fleet.key; give the robot's bundle: mapquilt fleet enroll DIR ROBOT makes it"
}

# File to place, through a new name: a reader never sees half of it.
place() { # mode source target
    mkdir -p "${3%/*}"
    rm -f "$3.new"
    (umask 077 && cp "$2" "$3.new")
    chmod "$1" "$3.new"
    mv -f "$3.new" "$3"
}

# What a program consists of: its rooms, and what installs its packages.
parts='agent protocol hw run requirements.lock requirements-dev.lock pyproject.toml LICENSE'

keep_old_program() {
    rm -rf "$before"
    [ -d "$home/agent" ] || return 0
    mkdir -p "$before"
    for part in $parts; do
        [ ! -e "$home/$part" ] || cp -Rp "$home/$part" "$before/$part"
    done
}

# A robot whose update fails goes on as it was: with the program that fits the packages it has.
go_back() {
    [ -d "$before" ] || stop 3 "the packages could not be installed (see above), so nothing is; with --wheelhouse it must be of this version: deploy/wheelhouse.sh"
    for part in $parts; do
        rm -rf "${home:?}/$part"
        [ ! -e "$before/$part" ] || mv "$before/$part" "$home/$part"
    done
    rm -rf "$before"
    stop 3 "the packages could not be installed (see above); the version of before is in place again. With --wheelhouse it must be of the new version: deploy/wheelhouse.sh"
}

place_program() {
    mkdir -p "$home"
    for room in agent protocol hw; do
        rm -rf "$home/$room.new"
        cp -R "$source/$room" "$home/$room.new"
        rm -rf "$home/$room"
        mv "$home/$room.new" "$home/$room"
    done
    for file in run requirements.lock requirements-dev.lock pyproject.toml LICENSE; do
        [ ! -f "$source/$file" ] || place 644 "$source/$file" "$home/$file"
    done
    chmod 755 "$home/run"
    find "$home" -name __pycache__ -path "$home/[aph]*" -prune -exec rm -rf {} +
}

place_packages() {
    if [ -n "$wheelhouse" ]; then
        PIP_NO_INDEX=1 PIP_FIND_LINKS=$wheelhouse UV_NO_INDEX=1 UV_FIND_LINKS=$wheelhouse UV_OFFLINE=1
        export PIP_NO_INDEX PIP_FIND_LINKS UV_NO_INDEX UV_FIND_LINKS UV_OFFLINE
    fi
    # The system's own Python first: one below /root or /home is out of the service's sight.
    PATH=/usr/bin:/bin:/usr/local/bin:$PATH "$home/run" --version || go_back
    rm -rf "$before"
    case $(readlink -f "$home/.venv/bin/python") in
        /root/* | /home/*) [ -n "$root" ] || stop 3 "only a Python in somebody's home was found, which a service may not read; install one with: apt-get install python3 python3-venv" ;;
    esac
    # The service may not write here, so what Python would keep for later starts is made now.
    "$home/.venv/bin/python" -m compileall -q "$home/agent" "$home/protocol" "$home/hw" || true
    chmod -R go+rX "$home"
}

# Who may read the keys.  Not named mapquilt: systemd names the service's own user so, and will not make it beside such a group.
make_group() {
    getent group "$group" >/dev/null || groupadd --system "$group"
    ! getent group mapquilt >/dev/null || getent passwd mapquilt >/dev/null || groupdel mapquilt
}

place_settings() {
    mkdir -p "$settings/fleet"
    place 644 "$here/robot.toml" "$settings/robot.toml.sample"
    [ -f "$settings/robot.toml" ] || place 644 "$here/robot.toml" "$settings/robot.toml"
    [ -n "$root" ] || make_group
    if [ -n "$keys" ]; then
        for file in "$keys"/*; do
            place 640 "$file" "$settings/fleet/${file##*/}"
        done
    fi
    [ -n "$root" ] || chgrp -R "$group" "$settings/fleet"
    chmod 750 "$settings/fleet"
}

place_system() {
    place 644 "$here/mapquilt@.service" "$unit"
    place 644 "$here/90-mapquilt.rules" "$rules"
    mkdir -p "${drivers%/*}" "${command%/*}"
    printf '%s\n' usbserial cdc_acm >"$drivers"
    ln -sfn /opt/mapquilt/.venv/bin/mapquilt "$command"
    place_help
    ! live modprobe || modprobe -a usbserial cdc_acm 2>/dev/null || true
    ! live udevadm || { udevadm control --reload && udevadm trigger --subsystem-match=tty; } 2>/dev/null || true
    ! systemd_runs || systemctl daemon-reload
}

place_help() {
    [ -x "$home/.venv/bin/mapquilt" ] || return 0
    mkdir -p "${completion%/*}" "${page%/*}"
    "$home/.venv/bin/mapquilt" completion bash >"$completion"
    "$home/.venv/bin/mapquilt" completion man >"$page"
}

# A robot that runs would load new files beside the old ones it holds.
restart_running() {
    ! systemd_runs || systemctl try-restart 'mapquilt@*.service'
}

start_service() {
    if ! systemd_runs; then
        say "no systemd runs here; start it by hand: mapquilt run --id $robot --config /etc/mapquilt/robot.toml"
        return
    fi
    systemctl enable "mapquilt@$robot"
    systemctl restart "mapquilt@$robot" || stop 3 "mapquilt@$robot does not start; see why: journalctl -u mapquilt@$robot -n 30"
    say "mapquilt@$robot runs; look at it: sudo mapquilt status"
}

uninstall() {
    if systemd_runs; then
        systemctl list-units --all --plain --no-legend 'mapquilt@*' | while read -r name _; do systemctl disable --now "$name" || true; done
    fi
    rm -rf "$home" "$before"
    rm -f "$command" "$unit" "$rules" "$drivers" "$completion" "$page"
    ! systemd_runs || systemctl daemon-reload
    if [ "$purge" = yes ]; then
        rm -rf "$settings" "$root/var/lib/mapquilt" "$root/var/lib/private/mapquilt"
        [ -n "$root" ] || ! getent group "$group" >/dev/null || groupdel "$group"
        say "gone, settings and maps too"
    else
        say "gone; settings in /etc/mapquilt and maps in /var/lib/mapquilt are kept (--purge removes them)"
    fi
}

check
if [ "$action" = uninstall ]; then
    uninstall
    exit 0
fi
keep_old_program
place_program
place_packages
place_settings
place_system
restart_running
say "installed in $home; settings: $settings/robot.toml; check this machine with: mapquilt doctor"
[ -z "$robot" ] || start_service
