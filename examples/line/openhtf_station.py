"""OpenHTF: one phase calibrates a unit and reports measurements with units and limits.

    python openhtf_station.py station.toml SERIAL

The station file has one unit, and limits. Every record goes to `results.json` beside it, with the whole outcome.
"""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import openhtf as htf
from openhtf.output.callbacks import json_factory
from openhtf.util.units import UnitDescriptor

STATION = Path(sys.argv[1])
LIMITS = tomllib.loads(STATION.read_text()).get("limits", {})
GRAVITY = UnitDescriptor("standard acceleration of free fall", "K40", "g")


def measurement(name: str, limit: str) -> htf.Measurement:
    """In g, with the limit of the station file, if it has one."""
    declared = htf.Measurement(name).with_units(GRAVITY)
    return declared.in_range(0, LIMITS[limit]) if limit in LIMITS else declared


@htf.measures(
    measurement("fit_rms", "rms_g"),
    measurement("fit_cross_validated_rms", "cross_validated_rms_g"),
    measurement("own_output_rms", "verification_rms_g"),
    htf.Measurement("code").equals("within_limits"),
)
def calibrate(test: htf.TestApi) -> htf.PhaseResult:
    slot = tomllib.loads(STATION.read_text())["units"][0]["name"]
    command = [sys.executable, "-m", "triaxcald.cli", "run", str(STATION), "--events"]
    command += ["--serial", f"{slot}={test.test_record.dut_id}"]
    outcome = None
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        for line in run.stdout:
            event = json.loads(line)
            if event["event"] == "poses" and event["next"]:
                test.logger.info("%s of %s poses; next %s", event["found"], event["wanted"], event["next"]["label"])
            if event["event"] == "ended":
                outcome = event["outcome"]
    if outcome is None:  # a wrong argument or a rule: nothing began, and standard error has the reason
        raise RuntimeError(f"triaxcal run: exit code {run.returncode}")
    test.measurements.code = outcome["code"]
    if outcome["measured"]:
        test.measurements.fit_rms = outcome["measured"]["after"]["rms_g"]
        test.measurements.fit_cross_validated_rms = outcome["measured"]["after"]["cross_validated_rms_g"]
    if outcome["verification"]:
        test.measurements.own_output_rms = outcome["verification"]["after_rms_g"]
    test.attach("outcome.json", json.dumps(outcome).encode(), "application/json")
    return htf.PhaseResult.STOP if outcome["verdict"] == "aborted" else htf.PhaseResult.CONTINUE


if __name__ == "__main__":
    test = htf.Test(calibrate, test_name="calibration")
    test.add_output_callbacks(json_factory.OutputToJSON(str(STATION.parent / "results.json"), indent=2))
    sys.exit(0 if test.execute(test_start=lambda: sys.argv[2]) else 1)
