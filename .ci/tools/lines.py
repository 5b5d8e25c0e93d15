"""Print the lines of code of each package of the product, their sum, and the lines of the tests."""

import subprocess
from collections import Counter
from pathlib import Path

SUFFIXES = (".py", ".js", ".glsl", ".vert", ".frag", ".html", ".css")

root = Path(__file__).resolve().parents[2]
listed = subprocess.check_output(
    ["git", "ls-files", "pansplat", "viewer", "shaders", "tests"], cwd=root, encoding="utf-8"
)
lines: Counter[str] = Counter()
for name in listed.splitlines():
    file = root / name
    if file.suffix in SUFFIXES and file.is_file():
        folder = "/".join(Path(name).parts[:-1][:3])
        lines["tests" if name.startswith("tests/") else folder] += len(file.read_text("utf-8").splitlines())
tests = lines.pop("tests")
for folder in sorted(lines):
    print(f"{lines[folder]:7,} {folder}")
print(f"{lines.total():7,} product\n{tests:7,} tests")
