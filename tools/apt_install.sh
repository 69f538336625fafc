#!/usr/bin/env bash
# apt_install.sh PACKAGE...: install the first of these packages that apt knows, as root or through sudo.
# Status 1 without output if that is impossible: the caller prints what to install by hand.
set -euo pipefail

command -v apt-get >/dev/null || exit 1
if [ "$(id -u)" -eq 0 ]; then
    as_root() { "$@"; }
elif command -v sudo >/dev/null && { [ -t 0 ] || sudo -n true 2>/dev/null; }; then
    as_root() { sudo "$@"; }
else
    exit 1
fi

first_known() {
    for package in "$@"; do
        # `apt-cache show` also succeeds for packages that others only mention; a candidate can be installed.
        policy=$(LC_ALL=C apt-cache policy "$package" 2>/dev/null)
        if [[ $policy == *"Candidate: "[^\(]* ]]; then
            echo "$package"
            return
        fi
    done
    return 1
}

# A bare machine or container has no package lists; stale ones name files that no longer exist.
package=$(first_known "$@") || { as_root apt-get update -q >&2 && package=$(first_known "$@"); } || exit 1
install() { as_root env DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends "$package" >&2; }
install || { as_root apt-get update -q >&2 && install; } || exit 1
