"""The shipped sample: its files, a free licence for every model."""

import hashlib
import json
import re
from pathlib import Path

SAMPLE = Path(__file__).parents[2] / "assets" / "living_room"
RECIPE = SAMPLE.parent / "recipe" / "living_room"


def test_every_model_is_credited_under_a_free_licence():
    credits = json.loads((SAMPLE / "credits.json").read_text())
    readme = (SAMPLE / "README.md").read_text()
    assert len(credits) >= 20
    for credit in credits:
        assert credit["licence"] in ("CC0 1.0", "CC BY 3.0", "CC BY 3.0 US")
        row = f"| {credit['model']} | {credit['title']} | {credit['author']} | {credit['licence']} |"
        assert row in readme, row


def test_readme_lists_the_checksum_of_every_file():
    listed = dict(re.findall(r"^([0-9a-f]{64})  (\S+)$", (SAMPLE / "README.md").read_text(), re.MULTILINE))
    found = {
        hashlib.sha256(p.read_bytes()).hexdigest(): p.name
        for p in SAMPLE.iterdir()
        if p.is_file() and p.name != "README.md"
    }
    assert listed == found


def test_the_recipe_has_no_absolute_paths():
    for path in [*RECIPE.iterdir(), *SAMPLE.glob("*.md"), *SAMPLE.glob("*.json")]:
        if path.is_file():
            assert not re.search(r"/(tmp|home|work|root|Users|media)/", path.read_text()), path
