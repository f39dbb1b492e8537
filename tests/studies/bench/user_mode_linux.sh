#!/bin/sh
# Run a command in a user-mode Linux with cgroup v2, where the kernel of this machine has its controllers in cgroup v1:
#   tests/studies/bench/user_mode_linux.sh .venv/bin/python -m tests.studies.bench slow_board --minutes 0.5 --share 0.4
# Needs root, 6 GB of memory, and the program linux.uml of Debian's package user-mode-linux, or its path in UML. The
# kernel has one processor and the files of this machine. The exit status is that of the command.
set -eu
[ $# -gt 0 ] || { sed -n '2,5s/^# //p' "$0" >&2; exit 2; }
command -v "${UML:=linux.uml}" >/dev/null || { echo "$UML is missing: apt-get install user-mode-linux" >&2; exit 2; }
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for word; do printf "'%s' " "$(printf %s "$word" | sed "s/'/'\\\\''/g")"; done >"$work/words"
cat >"$work/init" <<END
#!/bin/sh
export PATH='$PATH' HOME='${HOME:-/root}' PYTHONPATH=. OPENBLAS_NUM_THREADS=1 KNIGHTCUBE_COMPILED=0 TMPDIR=/dev/shm
mount -t proc proc /proc && mount -t sysfs sys /sys && mount -t cgroup2 cgroup2 /sys/fs/cgroup
mkdir -p /dev/pts /dev/shm && mount -t devpts devpts /dev/pts && mount -t tmpfs shm /dev/shm
ip link set lo up
cd '$PWD'
{ eval "\$(cat '$work/words')"; echo \$? >'$work/status'; } >'$work/out' 2>'$work/err'
echo o >/proc/sysrq-trigger
sleep 10
END
chmod +x "$work/init"
TMPDIR=/dev/shm "$UML" mem=6G root=/dev/root rootfstype=hostfs rootflags=/ rw init="$work/init" \
    con=null con0=null,fd:1 </dev/null >"$work/boot" 2>&1 || cat "$work/boot" >&2
cat "$work/out"
cat "$work/err" >&2
[ -s "$work/status" ] || { tail "$work/boot" >&2; exit 1; }
exit "$(cat "$work/status")"
