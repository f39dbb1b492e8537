#!/bin/sh
# Install the KnightCube flight software as a systemd service. Run the script again to update the software.
set -eu
umask 022 # the services, which run as other users, read what this script installs

usage() {
    cat <<'TEXT'
usage: install.sh [--config FILE] [--wheels DIR | --venv DIR] [--python PYTHON] [--dry-run]
       install.sh --accept [--dry-run]
       install.sh --rollback
       install.sh --uninstall [--purge] [--dry-run]

  --config FILE   configuration to fly; stored as /etc/knightcube/flight.yaml with its
                  checksum and never overwritten (default: config/board_testbed.yaml)
  --wheels DIR    install without a network, from the wheels in DIR
  --venv DIR      use this virtual environment, unchanged, instead of making one
  --python PYTHON make the virtual environment with this Python (default python3)
  --dry-run       print the steps without doing them
  --accept        accept /etc/knightcube/flight.yaml after it was edited
  --rollback      fly the previous release from the next start on
  --uninstall     stop and remove the service, the software and the udev rules
  --purge         with --uninstall: also configuration, flight logs, state and user

Folders:
  /opt/knightcube/releases  the software: the current and the previous release
  /opt/knightcube/bin    fly, coils-off         /etc/knightcube          configuration
  /opt/knightcube/spare  second copy of bin
  /opt/knightcube/venv   link to the current    /var/lib/knightcube      flight logs, state
  /etc/systemd/system    the units              /etc/udev/rules.d        device names
  /etc/modules-load.d    i2c-dev                /etc/systemd/system.conf.d  hardware watchdog
DESTDIR=FOLDER in the environment installs into an image mounted there; make its user yourself.
TEXT
}

fail() {
    echo "install: $1" >&2
    exit 2
}

root=${DESTDIR:-}
prefix=$root/opt/knightcube
settings=$root/etc/knightcube
units=$root/etc/systemd/system
rules=$root/etc/udev/rules.d/99-knightcube.rules
shipped=$prefix/share/99-knightcube.rules
modules=$root/etc/modules-load.d/knightcube.conf
watchdog=$root/etc/systemd/system.conf.d/knightcube.conf
logs=/var/lib/knightcube
cache=$root/var/cache/knightcube
user=knightcube
deploy=$(cd "$(dirname "$0")" && pwd)
source=$(dirname "$deploy")
config=
wheels=
venv=
python=python3
dry=
action=install
purge=

while [ $# -gt 0 ]; do
    case $1 in
        --config | --wheels | --venv | --python)
            case ${2:-} in
                '' | -*) fail "$1 needs a value, see --help" ;;
            esac
            case $1 in
                --config) config=$2 ;;
                --wheels) wheels=$2 ;;
                --venv) venv=$2 ;;
                --python) python=$2 ;;
            esac
            shift
            ;;
        --dry-run) dry=yes ;;
        --accept) action=accept ;;
        --rollback) action=rollback ;;
        --uninstall) action=uninstall ;;
        --purge) purge=yes ;;
        -h | --help)
            usage
            exit 0
            ;;
        *) fail "unknown option $1, see --help" ;;
    esac
    shift
done

# Run a command, or print it in a dry run.
run() {
    if [ -n "$dry" ]; then
        echo "would run: $*"
    else
        "$@"
    fi
}

# Install a file by one rename, unless an identical file is installed, so that a second run changes nothing.
place() {
    if ! cmp -s "$2" "$3" 2>/dev/null; then
        run install -D -m "$1" "$2" "$3.part"
        run mv -f "$3.part" "$3"
    fi
}

# Print the checksum file of a configuration, in the format of sha256sum.
sum_of() { sha256sum <"$1" | sed 's/-$/flight.yaml/'; }

# Reject wrong options before the first step.
check_inputs() {
    [ "$action" != uninstall ] || return 0
    [ -z "$purge" ] || fail "--purge needs --uninstall"
    [ "$action" = install ] || [ -z "$config$wheels$venv" ] || fail "--$action: omit --config, --wheels and --venv"
    if [ "$action" = rollback ]; then
        [ -e "$prefix/previous" ] || fail "--rollback: there is no previous release"
        return
    fi
    [ -z "$wheels" ] || [ -z "$venv" ] || fail "--wheels and --venv: give one of them"
    [ -z "$wheels" ] || [ -d "$wheels" ] || fail "--wheels $wheels: no such folder"
    [ -z "$venv" ] || [ -x "$venv/bin/python" ] ||
        fail "--venv $venv: no virtual environment, bin/python is missing"
    if [ "$action" = accept ]; then
        [ -e "$settings/flight.yaml" ] || fail "--accept: there is no $settings/flight.yaml"
        [ -x "$prefix/current/venv/bin/python" ] || fail "--accept: no release is installed: run install.sh first"
        return
    fi
    [ -n "$venv" ] || "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "--python $python: Python 3.11 or newer is needed"
    flown=${config:-$source/config/board_testbed.yaml}
    { [ -f "$flown" ] && [ -r "$flown" ]; } || fail "--config $flown: cannot be read"
    [ -e "$settings/flight.yaml" ] || return 0
    [ -z "$config" ] || cmp -s "$config" "$settings/flight.yaml" ||
        fail "--config $config: another configuration is installed: remove it first: rm $settings/flight.yaml"
    flown=$settings/flight.yaml
    [ ! -e "$flown.sha256" ] || [ "$(sum_of "$flown")" = "$(cat "$flown.sha256")" ] ||
        fail "$flown is not the accepted configuration: if you edited it, run install.sh --accept"
}

# Return whether systemd runs. In an image, neither systemd nor udev runs, so they are not reloaded.
systemd_runs() { [ -z "$root" ] && [ -d /run/systemd/system ]; }

in_root() { systemctl ${root:+--root="$root"} "$@"; }

reload() {
    if systemd_runs; then
        run systemctl daemon-reload
        [ -S /run/udev/control ] || return 0 # udev does not run in a container
        run udevadm control --reload
        run udevadm trigger --subsystem-match=tty --subsystem-match=i2c-dev --subsystem-match=video4linux \
            --subsystem-match=usb
    fi
}

make_user() {
    if [ -n "$root" ]; then
        echo "install: create a system user $user in the image, in the groups dialout, i2c and video," \
            "and for a link a system user $user-link of the group $user" >&2
        return
    fi
    for group in dialout i2c video; do
        getent group "$group" >/dev/null || run groupadd --system "$group"
    done
    getent passwd "$user" >/dev/null ||
        run useradd --system --user-group --home-dir "$logs" --no-create-home --shell /usr/sbin/nologin "$user"
    # The link runs as a separate user in the group of the flight. The link can read the logs and send commands to the
    # flight, but the flight cannot read the keys of the link.
    getent passwd "$user-link" >/dev/null ||
        run useradd --system --gid "$user" --home-dir "$logs-link" --no-create-home --shell /usr/sbin/nologin \
            "$user-link"
}

# Build and test a release beside the current release; deploy/build_release.py contains the steps.
build_release() {
    if [ -n "$venv" ]; then
        builder=$venv/bin/python
        set -- --venv "$venv"
    else
        builder=$python
        set -- --python "$python" ${wheels:+--wheels "$wheels"}
    fi
    if [ -n "$dry" ]; then
        "$builder" "$deploy/build_release.py" "$prefix" build --dry-run "$@"
        release=$prefix/current
        return
    fi
    mkdir -p "$prefix"
    release=$prefix/releases/$("$builder" "$deploy/build_release.py" "$prefix" build "$@")
}

# Make the new release current for the next start. Its launcher, which can start both releases, is installed first.
switch_release() {
    programs='coils-off fly releases.py safe_state.py renewal.py open_bundle.py board_dropin.py'
    for folder in "$prefix/bin" "$prefix/spare"; do
        for file in $programs; do
            place 755 "$deploy/$file" "$folder/$file"
        done
        place 644 "$source/hal/buses/smbus_byte.py" "$folder/smbus_byte.py"
        # The checksums are written last, so that after an interrupted update one folder matches its checksums.
        if [ -n "$dry" ]; then
            (cd "$folder" && sha256sum --check --strict --status sums) 2>/dev/null ||
                echo "would write: $folder/sums"
        else
            (cd "$folder" && sha256sum $programs smbus_byte.py >.sums)
            place 644 "$folder/.sums" "$folder/sums"
            rm -f "$folder/.sums"
        fi
    done
    run "$release/venv/bin/python" "$deploy/build_release.py" "$prefix" switch "$(basename "$release")"
}

# Older versions installed the software in $prefix/venv, and their systemd units start it from this folder.
link_venv() {
    [ "$(readlink "$prefix/venv")" != current/venv ] || return 0
    run rm -rf "$prefix/venv"
    run ln -s current/venv "$prefix/venv"
}

install_settings() {
    python=$release/venv/bin/python
    if [ -n "$dry" ] && [ ! -x "$python" ]; then
        echo "would write: $settings/flight.yaml and its checksum, from $flown"
        echo "would write: $units/knightcube.service.d/board.conf, from $flown; the link's unit if it has a link"
        return
    fi
    made=$(mktemp -d)
    trap 'rm -rf "$made"' EXIT
    # This is the first step, because it rejects an invalid configuration.
    "$python" "$deploy/board_dropin.py" "$flown" "$made" || exit 2
    place 644 "$flown" "$settings/flight.yaml"
    sum_of "$flown" >"$made/sum"
    place 644 "$made/sum" "$settings/flight.yaml.sha256"
    place 644 "$made/flight" "$units/knightcube.service.d/board.conf"
    place 644 "$made/safe" "$units/knightcube-safe.service.d/board.conf"
    if [ -s "$made/link" ]; then
        place 644 "$deploy/knightcube-link.service" "$units/knightcube-link.service"
        place 644 "$made/link" "$units/knightcube-link.service.d/board.conf"
        in_root is-enabled --quiet knightcube-link.service 2>/dev/null ||
            run in_root enable --quiet knightcube-link.service
    else
        remove_link
    fi
    [ -e "$made/tracker" ] || return 0
    wanted=$(XDG_CACHE_HOME="$cache" "$python" "$deploy/sky_index.py" --wanted "$flown")
    if [ -n "$wanted" ]; then
        run install -d "$cache" # systemd changes its owner to the service's user
        run env XDG_CACHE_HOME="$cache" "$python" "$deploy/sky_index.py" "$flown"
    fi
}

# The link's unit is installed only if the configuration has a link.
remove_link() {
    [ -e "$units/knightcube-link.service" ] || [ -e "$units/knightcube-link.service.d" ] || return 0
    if systemd_runs; then
        run systemctl stop knightcube-link.service || true
    fi
    if in_root is-enabled --quiet knightcube-link.service 2>/dev/null; then
        run in_root disable --quiet knightcube-link.service
    fi
    run rm -rf "$units/knightcube-link.service" "$units/knightcube-link.service.d"
}

# Install the udev rules, but keep rules that the user has edited.
install_rules() {
    if [ -e "$rules" ] && [ -e "$shipped" ] && ! cmp -s "$rules" "$shipped"; then
        cmp -s "$deploy/99-knightcube.rules" "$shipped" ||
            echo "install: $rules was edited and is kept; compare it with $deploy/99-knightcube.rules" >&2
    else
        place 644 "$deploy/99-knightcube.rules" "$rules"
    fi
    place 644 "$deploy/99-knightcube.rules" "$shipped"
}

# Enable the hardware watchdog of the board, and load the kernel module i2c-dev, which provides /dev/i2c-*, at each boot
# and now. No other software loads this module.
install_modules() {
    place 644 "$deploy/modules.conf" "$modules"
    place 644 "$deploy/watchdog.conf" "$watchdog"
    if systemd_runs && [ ! -d /sys/class/i2c-dev ]; then
        run modprobe i2c-dev ||
            echo "install: i2c-dev cannot be loaded: without it there is no /dev/i2c-* to reach the coils" >&2
    fi
}

install_units() {
    for unit in knightcube.service knightcube-safe.service knightcube-renewal.service knightcube-renewal.timer; do
        place 644 "$deploy/$unit" "$units/$unit"
    done
    [ ! -e "$settings/root.json" ] || place 644 "$settings/root.json" "$prefix/share/root.json"
    in_root is-enabled --quiet knightcube-renewal.timer 2>/dev/null ||
        run in_root enable --quiet knightcube-renewal.timer
    in_root is-enabled --quiet knightcube.service 2>/dev/null ||
        run in_root enable --quiet knightcube.service
}

# Store the configuration that was accepted on the ground. It is the last version to which the command-loss timer
# returns. If `$1` is `release`, this is done before the new release is made current. The trial of a renewal is ended,
# because the automatic return at its end would replace the installed release or configuration.
keep_accepted() {
    [ -n "$dry" ] || python3 -I -S "$deploy/renewal.py" --root "${root:-/}" --accepted "$1"
}

install_all() {
    make_user
    build_release
    install_settings
    keep_accepted release
    switch_release
    install_units
    link_venv
    install_rules
    install_modules
    reload
    command -v i2cset >/dev/null 2>&1 ||
        echo "install: i2cset is missing (package i2c-tools): without it, only Python sets the coils to zero" >&2
    say_next installed
}

accept_settings() {
    flown=$settings/flight.yaml
    release=$prefix/current
    install_settings
    keep_accepted configuration
    reload
    say_next accepted
}

roll_back() {
    say_next "rolled back to $("$prefix/previous/venv/bin/python" "$deploy/build_release.py" "$prefix" rollback)"
}

say_next() {
    if [ -z "$dry" ]; then
        sync # the board may lose its power at any time
        verb=start
        if systemd_runs && systemctl is-active --quiet knightcube.service; then
            verb=restart # the previous version is flying
        fi
        echo "$1. Fly: systemctl $verb knightcube    Watch: journalctl -fu knightcube"
    fi
}

uninstall_all() {
    remove_link
    if systemd_runs; then
        run systemctl stop knightcube-renewal.timer knightcube.service knightcube-safe.service || true
    fi
    if in_root is-enabled --quiet knightcube-renewal.timer 2>/dev/null; then
        run in_root disable --quiet knightcube-renewal.timer
    fi
    if in_root is-enabled --quiet knightcube.service 2>/dev/null; then
        run in_root disable --quiet knightcube.service
    fi
    run rm -rf "$units/knightcube.service" "$units/knightcube-safe.service" \
        "$units/knightcube-renewal.service" "$units/knightcube-renewal.timer" "$root$logs-renewal" \
        "$units/knightcube-renewal.service.d" \
        "$units/knightcube.service.d" "$units/knightcube-safe.service.d" "$rules" "$modules" "$watchdog" \
        "$prefix" "$cache"
    if [ -n "$purge" ]; then
        run rm -rf "$settings" "$root$logs" "$root$logs-link" "$root$logs-link-witness"
        if [ -z "$root" ] && getent passwd "$user" >/dev/null; then
            run userdel "$user"
        fi
        if [ -z "$root" ] && getent passwd "$user-link" >/dev/null; then
            run userdel "$user-link"
        fi
    fi
    reload
    [ -n "$dry" ] || echo "uninstalled${purge:+, with configuration, logs and user}"
}

[ -n "$dry$root" ] || [ "$(id -u)" -eq 0 ] || fail "run it as root (or preview with --dry-run)"
command -v systemctl >/dev/null || fail "no systemd on this machine: fly by hand with python -m flight run"
check_inputs
case $action in
    install) install_all ;;
    accept) accept_settings ;;
    rollback) roll_back ;;
    uninstall) uninstall_all ;;
esac
