#!/usr/bin/env bash
# Install the Debian packages of envs/apt.txt that are missing; without the right to, say the one line to type.
set -euo pipefail
command -v dpkg-query >/dev/null || exit 0
missing=()
while read -r package; do
  dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
done < <(grep -vE '^\s*(#|$)' "$(dirname "$0")/apt.txt")
[ ${#missing[@]} -gt 0 ] || exit 0
if [ "$(id -u)" = 0 ]; then
  apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "${missing[@]}" >/dev/null
else
  echo "system packages are missing; type: sudo apt-get install ${missing[*]}" >&2
fi
