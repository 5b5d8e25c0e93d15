#!/usr/bin/env bash
# Fetch the free furniture libraries into FOLDER/libraries (Debian package sweethome3d-furniture 1.8-1).
set -euo pipefail
folder="${1:?usage: fetch.sh FOLDER}"
mkdir -p "$folder/libraries" "$folder/download"
cd "$folder/download"
[ -e sweethome3d-furniture_1.8-1_all.deb ] || apt-get download sweethome3d-furniture=1.8-1
echo "3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668  sweethome3d-furniture_1.8-1_all.deb" | sha256sum --check
dpkg -x sweethome3d-furniture_1.8-1_all.deb unpacked
cp unpacked/usr/share/sweethome3d/furniture/*.sh3f ../libraries/
