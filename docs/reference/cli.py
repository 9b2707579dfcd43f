"""Writes docs/reference/cli.md from the commands and their help: `python docs/reference/cli.py`."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Container, Iterable, Iterator
from pathlib import Path

from triaxcald.cli.commands import parser
from triaxcald.cli.fitting import COLUMNS

PAGE = Path(__file__).with_suffix(".md")
HEAD = """# Command line

    triaxcal COMMAND …
    triaxcal --version

Results go to standard output; progress, warnings and errors go to standard error. With `--json` standard output holds one JSON document and nothing else ([Documents](certificate.md)). Made from the commands' own help (`triaxcal COMMAND --help`) by `docs/reference/cli.py`.

## Exit codes

| code | meaning |
|---|---|
| 0 | done, and within limits |
| 1 | done, but outside a limit; an audit found a difference; the demo did not find what was hidden; the units of `frame` did not stand on one fixture. A `run` outside a limit leaves the device as it was |
| 2 | bad input or usage: one line with file, line, field and what was expected; nothing was written |
| 3 | refused: the data or the device's registers cannot carry the answer, or calibration and device do not belong together; the line says which poses would help |
| 4 | a device or bus failed, [another command](#one-command-at-a-device) works with it, or the port of `--metrics` is taken. The line says what a device holds whose registers were being written |
| 5 | the disk failed or memory ran out; the recording is sound up to the stated time. Also if standard output takes no more |
| 130 | interrupted; the old calibration is untouched or back, unless the line says otherwise |

The worst code of several units counts, in the order 4, 130, 5, 3, 2, 1, 0.

Ctrl-C, SIGTERM and SIGHUP interrupt every command with one line and no file left half-written. A signal that was ignored from the start (`nohup`) stays ignored. `record` into a folder without a terminal takes SIGHUP as a request to [read its station file again](../how-to/run-as-a-service.md). On a bus the first and the second signal cancel the work, and the recording is finished or the old calibration restored. The third ends at once, with exit code 4 if registers were being written; the line names the command that settles the device. If Python does not return, a small process kills the command within two seconds (137 in a shell). [Why](../decisions/0036-stop-means-stop.md).

## One command at a device

`run`, `record`, `provision`, `restore`, `registers` and `demo` lock the device, and on a serial line the whole port, against other commands on this machine. The second command ends with exit code 4 and names the first; `record -o FOLDER` waits instead. Other units of one gateway or bus stay free; listening to a bus and `sim` lock nothing, but `sim` leaves word there of its units, for the error about a wrong one. The lock ends with its process. Its files are in `/run/lock`, else in `/tmp`; `TRIAXCAL_LOCK_FOLDER` names another folder for all commands, as for containers and a read-only root. [Why](../decisions/0035-one-command-at-a-device.md).

A result (`-o`, `--report`, the files of `run`) is written whole or not at all, and through no symbolic link (exit 2). Pipes, `/dev/null`, `/dev/stdout` and `/dev/fd/N` are written to as they are.

## Input

`REC` is a recording (`.mcap`, or the manifest `.segments.json` of one in [segments](recording.md#segments)), or a [table](tables.md): text with separators, Parquet, or `-` for text on standard input. A table that can be read in two ways is an error that names the option to settle it. Input beyond honest use is an error before it takes time or memory ([profile](profile.md#bounds), [recording](recording.md#bounds)). A JSON document has at most 4 MiB and 400,000 lists and objects, and each key once.

Poses are labelled by the side that is up: `+X`, `-X+Y` between two sides, `+X+Y+Z` a corner; `N1`, `N2` … are other directions of a plan. Up is the direction of the specific force at rest.

Keys of documents keep their `_g` whatever the unit of the reference is. Errors are shown in µg if the unit is `g`, in a power of ten of another unit, or in ppm of an unnamed one. The default unit is `g` for a magnitude of 0.9 to 1.1, else `reference unit`.

Several commands have these options:

"""  # noqa: E501
NOTES = {
    "demo": """Simulated time runs at up to twenty times real speed. Exit 1 also if the output after a loss of power is outside 50 µg. Document `triaxcal.demo/1`. `--page` serves the [page of a station](../how-to/run-a-station.md) until it is stopped.""",  # noqa: E501
    "run": """All units of a [station file](station.md) run at the same time. The guide is on standard error: `left: poses: 4 of 26 directions; next: +X+Y+Z up`. It counts new directions, held for long enough; the verification counts every still pose. Each unit gets a recording, a report, an [outcome](outcome.md) and, unless it failed, a certificate, in the station's folder. Registers are written only if the profile has one for each scale factor, misalignment and bias, the station allows it, and the result is within limits. A verification that is outside its limit or ends early restores the old calibration; without a limit, so does an output that is worse than before (exit 1). `--rezero` refuses a calibration of another unit before the first pose (exit 3). Document `triaxcal.run/1`.""",  # noqa: E501
    "serve": """[How to run a station](../how-to/run-a-station.md). SIGHUP reads the station file again between two trays. SIGTERM ends the runs under way in order, and the command with 0; Ctrl-C with 130. Exit 4 if the port is taken or the database does not answer.""",  # noqa: E501
    "sim": """DEVICE.toml is a [device file](device.md); several are [one tray](../how-to/run-as-a-service.md#a-tray-of-them). A line that is no event is counted and ignored, with a line on standard error. SIGTERM and SIGHUP end it with 0, Ctrl-C with 130. Only its own process reaches a unit on python-can's `virtual` bus; take `udp_multicast` between processes.""",  # noqa: E501
    "record": """Ends with 0 after `--seconds`, with 130 on a signal; either way the recording is finished. If another unit answers, or two units send at one place, the unit's recording ends (exit 4), and the records since the last confirmation are [unconfirmed](recording.md#unconfirmed-records). The events `interrupted` and `gap` say when, why and how many records were lost.

With `--segment-size` (default 256M) or `--segment-time` (default 1h) the recording is in [segments](recording.md#segments); `--keep` and `--keep-free` imply it. `--metrics` serves `/metrics` for Prometheus, `/health` (503 while a unit is lost) and a page. [Run as a service](../how-to/run-as-a-service.md).""",  # noqa: E501
    "fleet": """The runs are attempts that measured something, of a folder's [outcomes](outcome.md), of a file `triaxcal.sqlite` as it is, or of a PostgreSQL server with the runs of all its stations (extra `postgres`). Part numbers are taken apart. Effects and uncertainties come from certificates in the folder of the outcomes or of the file. The table (`--table`) has one row for each unit and figure: value, standard error, number of runs, deviation from the median in robust standard deviations, outlier (0 or 1), charts in which the unit is a signal, and the places of the unit's last run. Exit 0 also where something differs or drifts; 2 if no run has measured anything. [How to](../how-to/learn-from-many-units.md). Document [`triaxcal.fleet/1`](fleet.md).""",  # noqa: E501
    "results": """The runs are those of the [outcomes](outcome.md) in FOLDER itself, with the [columns of the document](results.md); folders below do not count. Without `-o` a table shows the time, the slot, the serial number, the attempt, PASS, FAIL, STOPPED or NO LIMIT with the [code](outcome.md#verdict-and-code), and the rms of the fit and of the check poses. Runs before version 0.2 have no start: their end counts. Files that are no outcome are left out and named. Exit 0 also if there is no run. [How to](../how-to/run-as-a-service.md#results-of-all-runs). Document `triaxcal.results/1`.""",  # noqa: E501
    "poses": """Document `triaxcal.poses/1`. Poses that [cannot be trusted](../explanation/data-quality.md) are marked with the reason.""",  # noqa: E501
    "fit": """Document `triaxcal.calibration/1`, with the [budget](../explanation/uncertainty.md) of its uncertainty. Only one of `--turning`, `--attitudes` and `--datasheet` may be given ([how](../how-to/other-methods.md)); with any there is no budget. A declared `--attitude-error` (0 to 0.3) stays in force if the residuals contradict it, with a warning. Without `--thermal-sensitivity` the station's or the profile's counts, else the odds of a thermal effect of up to three times 500 µg/K and 300 ppm/K.""",  # noqa: E501
    "diagnose": """[How](../explanation/diagnosis.md). Document `triaxcal.loop/1`. Four lines at the console:

| line | content |
|---|---|
| `verdict` | `usable`; `record more` if further poses are expected to tell what acts, a pose is an outlier, or more poses would improve the next recording; `investigate` if something unmodelled acts or one calibration does not hold in all poses |
| `cause` | what acts, each with its probability |
| `error` | before and after: held-out (with `--check`), cross-validated, in standard errors, χ² per degree of freedom, plain; the expanded uncertainty of \\|a\\| of this fit, of one more pose, and on another day |
| `next` | what to record next |

* Exit 0 whatever the verdict; `--limit` judges, with `--units` every unit.
* Several recordings are of one unit in order of time ([how](../how-to/diagnose-several-recordings.md)). Signs, references, output units and serial numbers must agree (exit 2), also of `--check`, which may not be among them.
* A warning says if a recording does not look like this unit: its error is above 5 % of the reference, or misalignment and ratios of scale factors of 12 poses or more differ by more than noise, age and 20 K explain.
* Poses of `--check` have effects of time as at `--at`.
* `--units` gives `triaxcal.agreement/1` and goes with neither `--check` nor `--report`.
* `--verbose` shows where scale factor, misalignment and bias hold (`at temp_c = 25 °C`). `empirical` is a smooth function of the direction. A suffix as in `x_run2` names one of several recordings. [All effects](effects.md).
""",  # noqa: E501
    "rezero": """[How](../how-to/use-a-calibration.md#the-next-day). Document `triaxcal.calibration/1` with [`rezero` and `origin`](calibration.md#biases-anew). Refused (exit 3): fewer than three distinct poses, poses that do not determine three biases, kept parameters that no longer fit, a constant output, a calibration of another unit, other signs, another reference or output unit. Distinct poses are 45° apart, or 10° if there are not so many.""",  # noqa: E501
    "apply": """A missing channel counts as at its reference, with a warning. [How to](../how-to/use-a-calibration.md).""",  # noqa: E501
    "verify": """Document `triaxcal.verify/1`. Untrusted poses are marked and in no figure; without others it is refused (exit 3). Signs and reference are the calibration's, and other ones are an error (exit 2). A warning says if the recording does not look like this unit, as for `diagnose --check`.""",  # noqa: E501
    "plan": """Document `triaxcal.plan/1`. Without REC: a plan in the order to take it, the uncertainty of its worst parameter, and the effects that it cannot show. `--poses` takes 9 to 1000 directions (200 with `--for`), 14 and 26 being those of a cube. `--for` chooses directions, and levels of channels, that tell the effects best; it is refused (exit 3) if no pose shows them. [How to](../how-to/plan-poses.md), [why](../explanation/plans.md).""",  # noqa: E501
    "frame": """Document `triaxcal.frame/1`. [How](../how-to/put-units-in-one-frame.md), [why](../explanation/frames.md). A disturbance of 1 s or more parts poses even if the reading is the same. In `--faces` the heading counts in degrees from a mark on the table to the body's next axis (y for x, z for y, x for z), counter-clockwise from above. `--datum` takes outward normals: the primary face is true, the secondary true in one direction. Exit 1 if units disagree on the faces (p below 0.01); the document is written all the same. Refused (exit 3): faces on one axis only, no second orientation and no `--table-tilt`, units without common faces.""",  # noqa: E501
    "provision": """[How, and what happens on failure](../how-to/provision-registers.md). Document `triaxcal.provisioning/1` with the [outcome](outcome.md). `--force` overrules [doubts about the old contents](../how-to/provision-registers.md#plausible-before-written). `--resume` takes the station alone.""",  # noqa: E501
    "restore": """The source is a recording (`registers-before.json`) or a journal; its registers go only to the unit with their serial number. Document `triaxcal.restoration/1` with `device_state`, `evidence`, `registers`, `error`, `outcome` and `outcome_file`.""",  # noqa: E501
    "registers": """Document `triaxcal.registers/1`.""",
    "devices": """Document `triaxcal.devices/1`.""",
    "devices check": """Shows streams with their places in the files, registers, roles, sequences, and the range and resolution of each calibration register as what it makes of 1 g. Of LOG: frames by identifier and kind with the streams that use them, samples, rate, channels that are constant, and |u| in the still poses over the nominal output per g (about 1). LOG may also be a recording of a unit. Exit 0 without [problems](profile-check.md#problems), 1 with any, 2 if profile or log cannot be read. Document [`triaxcal.profile_check/1`](profile-check.md).""",  # noqa: E501
    "devices new": """On standard output. Each value to replace is marked; optional keys are comments. The profile is sound as it is, beside the DBC or EDS that it names. [How](../how-to/describe-a-device.md#the-profile).""",  # noqa: E501
    "people add": """The roles are `reader`, `operator` and `engineer`; each may do what those before it may. The PIN has 4 to 64 characters, and only its argon2 hash is stored. It is asked twice at the terminal, or is the only line of `--pin-file`. Every change of people and tokens is a row of the trail, and counts at once in a service that runs.""",  # noqa: E501
    "people list": """By name, with the role and whether the person is disabled.""",
    "people pin": """Ends all sessions of the person. An unknown name is an error (exit 2), here and below.""",
    "people role": """Sessions of the person go on with the new role.""",
    "people disable": """Ends all sessions of the person, who stays in the list and in the trail.""",
    "people enable": """The person signs in with the PIN of before.""",
    "token new": """Programs send `Authorization: Bearer TOKEN`. Only the SHA-256 of the token is stored. Of one name there is one token that is not revoked (exit 2).""",  # noqa: E501
    "token list": """In the order of time, revoked ones too.""",
    "token revoke": """The name is free for another token.""",
    "audit": """[What it finds](../how-to/replay-and-audit.md). A folder stands for all `.mcap` files in it and below. Exit 0 if everything is the same byte for byte, or but for last digits of another processor; exit 1 if anything differs. [Years later](../how-to/replay-and-audit.md#years-later) `--within` bounds what other versions compute, and `--as-made` runs the recorded versions. A signal ends it with the number of recordings audited so far. Document `triaxcal.audit/1`.

[Many recordings](../how-to/audit-many-recordings.md): rows of `-o` are [stored as they come](many.md), and `--resume` goes on after any end. Fewer than 8 recordings are audited in this process, in the order given; more of them by a process on each core, where `pip install 'triaxcal[fleet]'` has brought Dask, and lines come as recordings are through. With `-o` only recordings that do not agree have lines. A recording for which memory or a worker ends has a row with exit code 5, and the others go on.""",  # noqa: E501
    "batch poses": """[How to](../how-to/audit-many-recordings.md). [Columns](many.md#batch-poses). Recordings in a folder are `.mcap` (or the manifest of segments), `.csv`, `.csv.gz` and `.parquet`, but TABLE; tables of other names are named one by one. Nothing is on standard output but a line that counts. Processes, rows and `--resume` are as for `audit`. The worst exit code of all recordings counts, here and below.""",  # noqa: E501
    "batch fit": """As [`fit`](#triaxcal-fit), each by itself. [Columns](many.md#batch-fit). Files of `--attitudes` and `--datasheet` go to the workers.""",  # noqa: E501
    "batch diagnose": """As [`diagnose`](#triaxcal-diagnose), each by itself. [Columns](many.md#batch-diagnose).""",
    "batch verify": """As [`verify`](#triaxcal-verify). [Columns](many.md#batch-verify).""",
    "batch apply": """As [`apply`](#triaxcal-apply), to NAME.csv in FOLDER, which is made where it is not there; workers elsewhere must reach it by the same path. A file that was there before is left, and its recording has exit code 2; with `--resume` a file that TABLE tells of is replaced if its recording has changed. Two recordings of one name are an error (exit 2). [Columns](many.md#batch-apply).""",  # noqa: E501
    "keys new": """[How](../how-to/sign-recordings.md). Private keys are encrypted (PKCS #8, scrypt), with file mode 0600, and never overwritten. A station signs by the only key in `keys` beside its station file, or by that of `[sign]`.""",  # noqa: E501
    "keys list": """Those in the folder `keys`, and those of the trust file.""",
    "keys trust": """Enters the key into `trust.toml`, which is made with `since` if there is none. An audit then takes unsigned recordings for differences.""",  # noqa: E501
    "keys revoke": """Signatures of the key are trusted no more, but for those that a time stamp shows to be from before.""",  # noqa: E501
    "log info": """Topics, phases, metadata, attachments, events, losses, and why it ended; also of a recording that was not finished, of [all frames of a bus](recording.md#all-frames-of-a-bus), and of segments. Of a long recording from its index. Document `triaxcal.recording/1`.""",  # noqa: E501
    "log recover": """Refuses (exit 3) if neither a whole message nor an attachment is left. [How](../how-to/replay-and-audit.md). Document `triaxcal.recovery/1`.""",  # noqa: E501
    "log delete": """Only recordings in the station's folder, and only of a station with a key. The tombstone is in the chain before anything is deleted.""",  # noqa: E501
    "log export": """A phase or stream without samples is an error (exit 2). The output must not exist.""",
    "log import": """LOG may be a recording of [all frames of a bus](recording.md#all-frames-of-a-bus). A summary of dropped frames is on standard error. [How](../how-to/import-a-log.md). Document `triaxcal.import/1`.""",  # noqa: E501
}
UNITS = """The columns of `--units`:

| column | |
|---|---|
"""


def page() -> str:
    commands = dict(commands_of(parser()))
    of_command = {
        name: {_key(a) for a in options(commands[name.removeprefix("batch ")])} for name in commands if _many(name)
    }
    shared = _shared([a for name, p in commands.items() for a in options(p) if _key(a) not in of_command.get(name, ())])
    tables = {o for g in commands["poses"]._action_groups if g.title == "tables" for o in names(g._group_actions)}
    head = HEAD + _table(list(shared.values()))
    known = {name: {*shared, *of_command.get(name, ())} for name in commands}
    return "\n".join([head, *(_section(name, p, known[name], tables) for name, p in commands.items())])


def _many(name: str) -> bool:
    """A command at many recordings has options of the command itself."""
    return name.startswith("batch ")


Key = tuple[tuple[str, ...], str | None, str]
"""Names, help and default of an option."""


def _key(a: argparse.Action) -> Key:
    return tuple(a.option_strings), a.help, _default(a)


def _shared(every: Iterable[argparse.Action]) -> dict[Key, argparse.Action]:
    """The options that several commands have alike."""
    every = list(every)
    count = Counter(map(_key, every))
    return {_key(a): a for a in every if count[_key(a)] > 1 and a.help}


def commands_of(top: argparse.ArgumentParser, prefix: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Each command by its name, also of those that have parts."""
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, p in action.choices.items():
                if p.get_default("run"):  # one with parts may be a command itself
                    yield f"{prefix}{name}", p
                yield from commands_of(p, f"{prefix}{name} ")


def options(p: argparse.ArgumentParser) -> list[argparse.Action]:
    return [a for a in p._actions if a.option_strings and "--help" not in a.option_strings]


def names(actions: list[argparse.Action]) -> list[str]:
    return [o for a in actions for o in a.option_strings]


def _section(name: str, p: argparse.ArgumentParser, shared: Container[Key], tables: set[str]) -> str:
    all_ = options(p)
    common = [a for a in all_ if _key(a) in shared]
    own = [a for a in all_ if a not in common]
    listed = [f"`{', '.join(a.option_strings)}`" for a in common if a.option_strings[0] not in tables]
    of_tables = [f"`{o}`" for o in names(common) if o in tables]
    parts = [f"## triaxcal {name}\n", f"    triaxcal {name} {_usage(p)}".rstrip() + "\n"]
    parts += [f"{p.description}\n", f"{NOTES[name]}\n"]
    parts += [_table(own)] if own else []
    parts += [UNITS + "".join(f"| {_cell(k)} | {_cell(v)} |\n" for k, v in COLUMNS.items())] * (name == "diagnose")
    of_tables = [f"of [tables](tables.md) {', '.join(of_tables)}"] if of_tables else []
    parts += [f"Also {', '.join(listed + of_tables)}.\n"] if listed or of_tables else []
    parts += [f"Example: `{p.epilog.removeprefix('example: ')}`\n"] if p.epilog else []
    return "\n".join(parts)


def _usage(p: argparse.ArgumentParser) -> str:
    """Required options and the arguments; the table has the rest."""
    words = [_call(a) for a in options(p) if a.required]
    for a in p._actions:
        if not a.option_strings:
            word = str(a.metavar or a.dest)
            words.append({"?": f"[{word}]", "+": f"{word}…"}.get(str(a.nargs), word))
    return " ".join(["[OPTIONS]" if any(not a.required for a in options(p)) else "", *words]).strip()


def _call(a: argparse.Action) -> str:
    return f"{a.option_strings[0]} {_value(a)}".rstrip()


def _value(a: argparse.Action) -> str:
    if a.nargs == 0:
        return ""
    word = str(a.metavar or ("|".join(map(str, a.choices)) if a.choices else a.dest.upper()))
    return f"{word}…" if a.nargs == "+" else word


def _table(actions: list[argparse.Action]) -> str:
    return "| option | meaning |\n|---|---|\n" + "".join(map(_row, actions))


def _row(a: argparse.Action) -> str:
    said = f"{a.help or ''}{'' if a.help is None or _default(a) == '' else '; '}{_default(a)}"
    call = f"`{', '.join(a.option_strings)} {_value(a)}".rstrip() + "`"
    return f"| {_cell(call)} | {_cell(said)} |\n"


def _cell(text: str) -> str:
    return text.replace("|", r"\|")


def _default(a: argparse.Action) -> str:
    plain = a.default in (None, False, 0.0) or a.default == [] or "default" in (a.help or "")
    return "" if plain else f"default: {a.default}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
