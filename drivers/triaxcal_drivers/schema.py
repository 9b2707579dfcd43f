"""The JSON Schema of a driver's profiles: ``python -m triaxcal_drivers.schema
modbus``."""

from __future__ import annotations

import json
import sys

from triaxcal_drivers.catalogue import driver_named
from triaxcal_drivers.errors import DriverMissing


def schema(driver: str) -> str:
    """The schema as text, with a newline at its end. Raises DriverMissing."""
    document = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    document |= driver_named(driver).profile_model.model_json_schema()
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


def main() -> int:
    if len(sys.argv) != 2:
        print("usage: python -m triaxcal_drivers.schema DRIVER", file=sys.stderr)
        return 2
    try:
        sys.stdout.write(schema(sys.argv[1]))
    except DriverMissing as e:
        print(e, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
