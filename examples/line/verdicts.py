"""Prints PASS or FAIL of each unit as it comes: `python verdicts.py station.toml [OPTIONS of triaxcal run]`."""

import json
import subprocess
import sys

WORDS = {"pass": "PASS", "fail": "FAIL", "aborted": "STOPPED", "not_judged": "NO LIMIT"}

command = [sys.executable, "-m", "triaxcald.cli", "run", *sys.argv[1:], "--events"]
with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
    for line in run.stdout:
        event = json.loads(line)
        if event["event"] == "ended":
            outcome = event["outcome"]
            serial = outcome["serial"] or outcome["work"]["serial"] or "unknown"
            print(f"{WORDS[outcome['verdict']]:<8} {event['unit']} {serial}: {outcome['code']}", flush=True)
sys.exit(run.returncode)
