#!/bin/sh
# Runs Frama-C's Eva over prove.c and prints a line for each function; exit status 1 when anything is left unproved.
cd "$(dirname "$0")" || exit 2
if ! command -v frama-c >/dev/null; then
    echo "proof: found no frama-c, wanted it on the PATH (Debian: apt install frama-c-base)" >&2
    exit 2
fi
status=0
for machine in gcc_x86_16 gcc_x86_64; do
    for what in $(sed -n 's/^void \(prove_[a-z]*\)(void).*/\1/p' prove.c); do
        report=$(frama-c -machdep "$machine" -c11 -cpp-extra-args="-I../src" -main "$what" -lib-entry \
            -eva -eva-precision 3 -eva-auto-loop-unroll 64 prove.c 2>&1)
        if echo "$report" | grep -q "^  0 alarms generated" && echo "$report" | grep -q "^  100% of the logical properties"; then
            echo "$machine $what: proved ($(echo "$report" | sed -n 's/.* \([0-9]* statements reached (out of [0-9]*)\).*/\1/p'))"
        else
            echo "$machine $what: NOT proved"
            echo "$report" | grep -A3 -E "eva:alarm|status unknown|error" | head -40
            status=1
        fi
    done
done
exit $status
