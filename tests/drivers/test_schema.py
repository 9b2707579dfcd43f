"""The JSON Schemas in the documentation are those of the code, and fit the built-in profiles."""

import json
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest

from triaxcal_drivers.catalogue import BUILT_IN

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"


@pytest.mark.parametrize("driver", ["can", "modbus"])
def test_the_committed_schema_is_what_the_command_prints(driver):
    printed = subprocess.run(
        [sys.executable, "-m", "triaxcal_drivers.schema", driver], capture_output=True, check=True, timeout=30
    ).stdout
    committed = json.loads((REFERENCE / f"profile-{driver}.schema.json").read_bytes())
    assert json.loads(printed) == committed, "the schema is stale; run make docs"


def test_the_page_of_the_keys_is_that_of_the_models():
    names = runpy.run_path(str(REFERENCE / "profile-keys.py"))
    assert names["PAGE"].read_text("utf-8") == names["page"](), "run make docs"


def test_every_key_of_a_profile_says_what_it_is():
    rows = re.findall(r"^\| (`.*) \|$", (REFERENCE / "profile-keys.md").read_text("utf-8"), re.MULTILINE)
    assert rows
    assert [row for row in rows if not row.split(" | ")[-1].strip()] == []


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(BUILT_IN.glob("*.toml")), ids=lambda p: p.stem)
def test_built_in_profiles_fit_the_schema_of_their_driver(path):
    profile = tomllib.loads(path.read_text("utf-8"))
    schema = json.loads((REFERENCE / f"profile-{profile['driver']}.schema.json").read_bytes())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(profile, schema)
    with pytest.raises(jsonschema.ValidationError, match="colour"):
        jsonschema.validate(profile | {"colour": 1}, schema)


def test_an_unknown_driver_is_named_and_nothing_printed():
    done = subprocess.run(
        [sys.executable, "-m", "triaxcal_drivers.schema", "modbuss"], capture_output=True, text=True, timeout=30
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "no driver named 'modbuss'; did you mean 'modbus'?\n"
