#!/bin/sh
# Brings what Python's packages cannot on a fresh Debian or Ubuntu: venv, and the shared libraries
# that Open3D links against. Does nothing where all are there. As root, or with sudo, apt installs
# them; for anyone else the libraries are unpacked into .venv/lib, where Open3D looks as well.
set -eu
cd "$(dirname "$0")/.."

command -v apt-get > /dev/null || exit 0 # macOS, or another Linux
missing=""
python3 -c "import ensurepip" 2> /dev/null || missing="python3-venv"
libraries=""
for pair in libEGL.so.1:libegl1 libGL.so.1:libgl1 libX11.so.6:libx11-6 libgomp.so.1:libgomp1 \
  libidn2.so.0:libidn2-0 libudev.so.1:libudev1 libusb-1.0.so.0:libusb-1.0-0; do
  PATH="$PATH:/sbin:/usr/sbin" ldconfig -p | grep -q "${pair%:*}" || libraries="$libraries ${pair#*:}"
done
[ -n "$missing$libraries" ] || exit 0

if [ "$(id -u)" = 0 ]; then as_root=""; elif sudo -n true 2> /dev/null; then as_root="sudo"; else as_root="none"; fi
if [ "$as_root" != none ]; then
  echo "apt installs:$libraries $missing"
  $as_root apt-get update -qq
  # shellcheck disable=SC2086
  $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $libraries $missing
  exit 0
fi

if [ -n "$missing" ]; then
  echo "Python 3.11 or newer with venv must be installed; it is not. Ask whoever runs this machine" \
    "for: apt-get install python3-venv" >&2
  exit 1
fi
folder="${VIRTUAL_ENV:-.venv}/lib"
[ -z "$(find "$folder" -maxdepth 1 -name 'libusb*' 2> /dev/null)" ] || exit 0 # an earlier run's
echo "without root: unpacks$libraries into $folder"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
mkdir -p "$scratch/lists/partial" "$scratch/archives/partial" "$scratch/root" "$folder"
apt() {
  apt-get -qq -o Dir::State::lists="$scratch/lists" -o Dir::Cache="$scratch" \
    -o APT::Sandbox::User="" -o Debug::NoLocking=1 "$@"
}
apt update
# With what these link against in turn, but without drivers: nothing is drawn on a screen.
# shellcheck disable=SC2086
(cd "$scratch" && apt download $libraries libglx0 libglvnd0 libxcb1 libxau6 libxdmcp6 libbsd0 libmd0)
for package in "$scratch"/*.deb; do dpkg-deb -x "$package" "$scratch/root"; done
find "$scratch/root" -name 'lib*.so*' -exec cp -P {} "$folder" \;
