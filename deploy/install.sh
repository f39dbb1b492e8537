#!/bin/sh
# Install the KnightCube flight software as a systemd service; run again at any time to bring it up to date.
set -eu

usage() {
    cat <<'TEXT'
usage: install.sh [--config FILE] [--wheels DIR | --venv DIR] [--python PYTHON] [--dry-run]
       install.sh --uninstall [--purge] [--dry-run]

  --config FILE   configuration to fly; kept as /etc/knightcube/flight.yaml, which is
                  not overwritten when it is there (default: config/testbed.yaml)
  --wheels DIR    install without a network, from the wheels in DIR
  --venv DIR      use this virtual environment instead of making one
  --python PYTHON make the virtual environment with this Python (default python3)
  --dry-run       say what would be done, do nothing
  --uninstall     stop and remove the service, the software and the udev rules
  --purge         with --uninstall: configuration, flight logs, state and user too

What goes where:
  /opt/knightcube/venv   the software           /etc/knightcube          configuration
  /opt/knightcube/bin    coils-off              /var/lib/knightcube      flight logs, state
  /etc/systemd/system    the units              /etc/udev/rules.d        device names
TEXT
}

fail() {
    echo "install: $1" >&2
    exit 2
}

prefix=/opt/knightcube
settings=/etc/knightcube
units=/etc/systemd/system
rules=/etc/udev/rules.d/99-knightcube.rules
logs=/var/lib/knightcube
cache=/var/cache/knightcube
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
            [ $# -ge 2 ] || fail "$1 wants a value, see --help"
            case $1 in
                --config) config=$2 ;;
                --wheels) wheels=$2 ;;
                --venv) venv=$2 ;;
                --python) python=$2 ;;
            esac
            shift
            ;;
        --dry-run) dry=yes ;;
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

# Do a command, or say it.
run() {
    if [ -n "$dry" ]; then
        echo "would run: $*"
    else
        "$@"
    fi
}

# Put a file in place unless the very same is there: nothing is touched by a second run.
place() {
    if ! cmp -s "$2" "$3" 2>/dev/null; then
        run install -D -m "$1" "$2" "$3"
    fi
}

# systemd and udev are told where they run; an image that is being built has neither.
systemd_runs() { [ -d /run/systemd/system ]; }

reload() {
    if systemd_runs; then
        run systemctl daemon-reload
        run udevadm control --reload
        run udevadm trigger --subsystem-match=tty --subsystem-match=i2c-dev --subsystem-match=video4linux
    fi
}

make_user() {
    for group in dialout i2c video; do
        getent group "$group" >/dev/null || run groupadd --system "$group"
    done
    getent passwd "$user" >/dev/null ||
        run useradd --system --user-group --home-dir "$logs" --no-create-home --shell /usr/sbin/nologin "$user"
}

install_software() {
    [ -d "$prefix/bin" ] || run mkdir -p "$prefix/bin"
    if [ -n "$venv" ]; then
        [ -x "$venv/bin/python" ] || fail "--venv $venv: no virtual environment, bin/python is missing"
        target=$(cd "$venv" && pwd)
        [ "$(readlink "$prefix/venv")" = "$target" ] || run ln -sfn "$target" "$prefix/venv"
    else
        [ ! -L "$prefix/venv" ] || run rm "$prefix/venv"
        "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
            fail "--python $python: Python 3.11 or newer is wanted"
        [ -x "$prefix/venv/bin/python" ] || run "$python" -m venv "$prefix/venv"
        if [ -n "$wheels" ]; then
            set -- --no-index --find-links "$wheels"
        else
            set --
        fi
        run "$prefix/venv/bin/pip" install --quiet --upgrade --constraint "$source/requirements.lock" "$@" "$source"
    fi
    place 755 "$deploy/coils-off" "$prefix/bin/coils-off"
    place 644 "$source/hal/buses/smbus_byte.py" "$prefix/bin/smbus_byte.py"
}

install_settings() {
    if [ -e "$settings/flight.yaml" ]; then
        if [ -n "$config" ] && ! cmp -s "$config" "$settings/flight.yaml"; then
            echo "install: $settings/flight.yaml is kept; yours would be put there after: rm $settings/flight.yaml" >&2
        fi
        flown=$settings/flight.yaml
    else
        flown=${config:-$source/config/testbed.yaml}
        [ -r "$flown" ] || fail "--config $flown: cannot be read"
        place 644 "$flown" "$settings/flight.yaml"
    fi
    if [ -n "$dry" ] && [ ! -x "$prefix/venv/bin/python" ]; then
        echo "would write: $units/knightcube.service.d/board.conf, from $flown"
        return
    fi
    made=$(mktemp)
    if ! "$prefix/venv/bin/python" "$deploy/board_dropin.py" "$flown" >"$made"; then
        rm -f "$made"
        exit 2
    fi
    place 644 "$made" "$units/knightcube.service.d/board.conf"
    grep -e '^#' -e '^\[Service\]' -e '^Environment=' -e '^DeviceAllow=/dev/i2c' "$made" >"$made.safe"
    place 644 "$made.safe" "$units/knightcube-safe.service.d/board.conf"
    rm -f "$made" "$made.safe"
    # The star tracker's sky index takes seconds to make: now, not at the start of a flight.
    if grep -q '^ *star_tracker:' "$flown"; then
        run install -d -o "$user" -g "$user" "$cache"
        run env XDG_CACHE_HOME="$cache" "$prefix/venv/bin/python" -c \
            'from flight.startracker.build import ensure_default_index; ensure_default_index()'
    fi
}

install_units() {
    for unit in knightcube.service knightcube-safe.service; do
        place 644 "$deploy/$unit" "$units/$unit"
    done
    place 644 "$deploy/99-knightcube.rules" "$rules"
    systemctl is-enabled --quiet knightcube.service 2>/dev/null ||
        run systemctl enable --quiet knightcube.service
}

install_all() {
    make_user
    install_software
    install_settings
    install_units
    reload
    command -v i2cset >/dev/null 2>&1 ||
        echo "install: i2cset is missing (package i2c-tools): the coils are then zeroed by Python alone" >&2
    [ -n "$dry" ] || echo "installed. Fly: systemctl start knightcube    Watch: journalctl -fu knightcube"
}

uninstall_all() {
    if systemd_runs; then
        run systemctl stop knightcube.service knightcube-safe.service || true
    fi
    if systemctl is-enabled --quiet knightcube.service 2>/dev/null; then
        run systemctl disable --quiet knightcube.service
    fi
    run rm -rf "$units/knightcube.service" "$units/knightcube-safe.service" \
        "$units/knightcube.service.d" "$units/knightcube-safe.service.d" "$rules" "$prefix" "$cache"
    if [ -n "$purge" ]; then
        run rm -rf "$settings" "$logs"
        if getent passwd "$user" >/dev/null; then
            run userdel "$user"
        fi
    fi
    reload
    [ -n "$dry" ] || echo "uninstalled${purge:+, with configuration, logs and user}"
}

[ -n "$dry" ] || [ "$(id -u)" -eq 0 ] || fail "run it as root (or look with --dry-run)"
command -v systemctl >/dev/null || fail "no systemd on this machine: fly by hand with python -m flight run"
if [ "$action" = install ]; then
    install_all
else
    uninstall_all
fi
