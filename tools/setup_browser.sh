#!/usr/bin/env bash
# setup_browser.sh: install Chromium for the browser tests, by apt, unless there is one.
set -euo pipefail
cd "$(dirname "$0")/.."

for browser in chromium chromium-browser google-chrome google-chrome-stable; do
    if command -v "$browser" >/dev/null; then exit 0; fi
done
# Ubuntu's package chromium-browser only installs a snap, which containers cannot run.
tools/apt_install.sh chromium || {
    echo "setup: no Chromium found: install one (apt-get install chromium) to run the browser tests." >&2
    exit 1
}
