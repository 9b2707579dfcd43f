"""The commands demo, run and sim."""

from __future__ import annotations

import argparse
import asyncio
import shutil
import signal
import sys
from collections.abc import Sequence
from contextlib import AsyncExitStack, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.cli.bars import Bars, verdict_line
from triaxcald.cli.console import emit, micro, say, show, showing, table
from triaxcald.cli.events import EventLines, Several, writes_to
from triaxcald.cli.interrupt import Interrupted, run_interruptible
from triaxcald.cli.showing import counted
from triaxcald.errors import InputError, severest
from triaxcald.station.config import check_lines, load_station

if TYPE_CHECKING:  # a command imports its work once its file is known to be good: matplotlib and all, it takes longer
    from triaxcald.demo import DemoUnit
    from triaxcald.run.unit_run import Outcome
    from triaxcald.schema.run import UnitOfDemo, UnitOfRun
    from triaxcald.simulation.follow import ServiceEvents, Source
    from triaxcald.simulation.tray import Tray


def run_command(a: argparse.Namespace) -> int:
    if a.json and a.events:
        raise InputError("--events: standard output has one JSON object a line, or with --json one document; give one")
    station = load_station(a.station)
    station.require_units()
    from triaxcald.run.attempts import settle_killed
    from triaxcald.signing.station import signing_of

    signing_of(station)  # a run that cannot sign ends here
    from triaxcald.run.orders import with_serials, works

    for killed in settle_killed(station):  # they count as attempts
        say(killed.line)
    station = with_serials(station, a.serial)
    given = {key: getattr(a, key) for key in ("operator", "order", "batch", "part_number", "fixture", "reason")}
    work = works(station, given)
    if station.file.rules.golden is not None:
        from triaxcald.run.golden_unit import golden_calibration

        golden_calibration(station)  # a unit that has no serial number yet may be the golden one
    rezero = {}
    if a.rezero:
        from triaxcald.earlier_calibration import earlier_by_unit

        rezero = earlier_by_unit(a.rezero, station)
    from triaxcald.learned_odds import odds_for

    odds = odds_for(station, work, a.odds)
    check_lines(station.places, where=str(station.path))
    from triaxcald.run.unit_run import TrayRun
    from triaxcald.schema.run import Run

    with ExitStack() as stack:
        bars = stack.enter_context(Bars(place.unit.name for place in station.places))
        receivers: list[Any] = [bars]
        lines: EventLines | None = None

        def ended(outcome: Outcome) -> None:
            say_data_quality(outcome)
            for receiver in receivers:
                receiver.ended(outcome)

        def begun() -> None:
            for events in receivers[1:]:
                events.begun()

        tray = TrayRun(
            station, Several(receivers), force=a.force, rezero=rezero, work=work, odds=odds,
            ended=ended, killed=lambda killed: say(killed.line), begun=begun,
        )  # fmt: skip
        if a.events:
            runs = {slot: unit.run for slot, unit in tray.units.items()}
            write = stack.enter_context(writes_to(sys.stdout))
            lines = stack.enter_context(EventLines(write, tray.id, runs))
            receivers.append(lines)
        outcomes = run_interruptible(tray)
    with showing(worst(outcomes), _told(outcomes)):
        if lines is not None and lines.trouble is not None:
            raise lines.trouble
        if a.json:
            emit(Run(format="triaxcal.run/1", units=[_unit(o) for o in outcomes]).document())
        elif not a.events:
            for o in outcomes:
                if o.error is None:
                    show_summary(o)
    return worst(outcomes)


def _told(outcomes: Sequence[Outcome]) -> str:
    """Outcomes of the units without an error message."""
    each = [
        (o, [f"{o.document['verdict']}: {o.document['reason']}", o.recovery_command])
        for o in outcomes
        if o.error is None
    ]
    return "; ".join(f"unit {o.unit}: {'; '.join(filter(None, told))}" for o, told in each)


def worst(outcomes: Sequence[Outcome]) -> int:
    return severest(o.exit_code for o in outcomes)


def _unit(o: Outcome) -> UnitOfRun:
    from triaxcald.schema.outcome import Outcome as OutcomeDocument
    from triaxcald.schema.run import UnitOfRun
    from triaxcald.schema.verification import Verification

    result = o.certified.document["result"] if o.certified else {}
    return UnitOfRun(
        unit=o.unit,
        exit_code=o.exit_code,
        error=o.error,
        wanted_poses=list(o.wanted),
        data_quality=list(o.data_quality),
        serial=o.document["serial"] if o.certified or o.verification else None,
        recording=_text(o.recording),
        certificate=_text(o.certificate),
        report=_text(o.report),
        before=tc.schema.Residual.model_validate(result["before"]) if result else None,
        after=tc.schema.Residual.model_validate(result["after"]) if result else None,
        findings=result.get("findings", []),
        candidates=result.get("candidates", []),
        choices=result.get("choices", []),
        registers_written=list(o.provisioned.written) if o.provisioned else [],
        device_state=o.device_state,
        outcome=OutcomeDocument.model_validate(o.document),
        outcome_file=_text(o.outcome),
        signature_file=_text(o.signature),
        records_lost=o.lost,
        verification=None if o.verification is None else Verification.model_validate(o.verification),
    )


def _text(path: Path | None) -> str | None:
    return str(path) if path else None


def say_data_quality(o: Outcome) -> None:
    for line in o.data_quality:
        say(f"warning: unit {o.unit}: {line}")


def show_summary(o: Outcome) -> None:
    """What became of a unit in a few lines; the report has the tables."""
    show(verdict_line(o))
    if o.certified is not None:
        b, f = o.certified.before, o.certified.calibration.residual
        fit = f"fit {micro(b.cross_validated_rms_g)} before, {micro(f.cross_validated_rms_g)} after"
        own = o.verification
        checked = f"; own output {micro(own['before_rms_g'])} before, {micro(own['after_rms_g'])} after" if own else ""
        show(f"         µg rms: {fit}{checked}")
        show(f"         terms: {', '.join(o.certified.calibration.terms)}")
    elif o.verification is not None:  # a golden unit: the line above has the figure
        show("         verified alone, nothing is written")
    if o.device_state is not None:
        show(f"         {o.device_state}")
    if (path := o.report or o.outcome) is not None:
        show(f"         {path}")


def show_outcome(o: Outcome, extra: Sequence[Sequence[str]] = ()) -> None:
    """The before / after table of one unit, and where its artifacts are."""

    assert o.certified is not None
    c, v = o.certified.calibration, o.verification
    b, f = o.certified.before, c.residual
    rows: list[Sequence[Any]] = [
        ["fit: cross-validated rms", micro(b.cross_validated_rms_g), micro(f.cross_validated_rms_g), ""],
        ["fit: residual rms", micro(b.rms_g), micro(f.rms_g), micro(f.noise_floor_g)],
    ]
    if v:
        rows.append(
            ["device's own output", micro(v["before_rms_g"]), micro(v["after_rms_g"]), micro(v["noise_floor_g"])]
        )
    table(
        f"unit {o.unit}, serial {o.certified.document['unit']['serial'] or 'unknown'}: error of the magnitude, µg rms",
        ["", "before", "after", "noise floor"],
        [*rows, *extra],
    )
    for line in o.certified.document["result"]["summary"]:
        show(f"  {line}")
    least = tc.evidence.Odds().reported
    weights = {e.name: c.weights.get(e.name, 1.0) for e, _ in c.sensor.effects}
    likely = [effect for effect, _ in c.sensor.effects if weights[effect.name] >= least]
    rest = {e.name: weights[e.name] for e, _ in c.sensor.effects if e not in likely}
    if rest:
        each = ", ".join(f"{name} ({tc.text.diagnosis.chance(p)})" for name, p in rest.items())
        show(f"  corrected as far as it is probable: {each}")
    for effect in likely:
        show(f"  corrected: {effect.name} (share {tc.text.diagnosis.chance(weights[effect.name])})")
        for name, (value, error, unit) in c.coefficients_of(effect.name).items():
            show(f"    {name} {tc.rounding.concise(value, error, unit)}")
    if o.provisioned:
        show(f"  {text.provisioned(o.provisioned)}")
    if o.recovery_command and o.error is None:
        show(f"  {o.recovery_command}")
    if v:
        left_out = sum(not p["used"] for p in v["poses"])
        poses = f"; {counted(len(v['poses']), left_out, 'check poses')}" if left_out else ""
        show(f"  verified by physics: {v['verdict']}{poses}")
    if not o.provisioned and o.certified.document["not_written"]:
        show(f"  no registers written: {o.certified.document['not_written']}")
    if o.lost:
        show(
            f"  {tc.number_format.number_of(o.lost, 'record')} {'was' if o.lost == 1 else 'were'} lost between "
            "bus and disk"
        )
    show(f"  verdict: {o.document['verdict']}: {o.document['reason']}")
    for line in o.certified.document["outside"]:
        show(f"  outside limits: {line}")
    for line in o.certified.document["result"]["data_quality"]:
        show(f"  warning: {line}")
    if creep := tc.text.advice.of_creep([p.pose for p in c.poses]):
        show(f"  creeping poses: {creep}")
    for caution in c.cautions:
        show(f"  warning: {tc.text.caution(caution)}")
    artifacts = {
        "recording": o.recording,
        "certificate": o.certificate,
        "report": o.report,
        "outcome": o.outcome,
        "signature": o.signature,
    }
    for what, path in artifacts.items():
        if path is not None:
            show(f"  {what:<12}{path}")


def demo_command(a: argparse.Namespace) -> int:
    if fault := td.hints.absent(("can", "pymodbus")):
        raise InputError(f"demo: {fault}")
    if a.page:
        from triaxcald.cli.serve import demo_page

        return demo_page(a)
    from triaxcald.demo import run_demo
    from triaxcald.schema.run import Demo

    with Bars(("can", "modbus")) as bars:

        def ended(outcome: Outcome) -> None:
            say_data_quality(outcome)
            bars.ended(outcome)

        units = run_interruptible(run_demo(a.out, a.seed, bars, ended))
    code = worst([u.outcome for u in units]) or (0 if all(u.found and u.kept for u in units) else 1)
    with showing(code, ""):  # its devices are gone with it
        if a.json:
            emit(Demo(format="triaxcal.demo/1", units=[_demo_unit(u) for u in units]).document())
        else:
            for u in units:
                if u.outcome.error is None:
                    _show_demo(u)
            _show_next(a.out, units)
    return code


def _demo_unit(u: DemoUnit) -> UnitOfDemo:
    from triaxcald.schema.run import UnitOfDemo

    cycled = u.after_power_cycle
    return UnitOfDemo(
        **dict(_unit(u.outcome)),
        hidden={name: dict(values) for name, values in u.hidden.items()},
        found=u.found,
        kept=u.kept,
        after_power_cycle_rms_g=tc.rounding.number(cycled.rms_g) if cycled else None,
    )


def _show_next(folder: Path, units: Sequence[DemoUnit]) -> None:
    reports = [u.outcome.report for u in units if u.outcome.report is not None]
    show("next:")
    if reports:
        show(f"  open {reports[0]} in a browser: what was found, with pictures")
    command = "triaxcal" if shutil.which("triaxcal") else sys.argv[0]
    show(f"  {command} audit {folder}: both results recomputed from the recordings alone")
    tutorial = "docs/tutorial/first-calibration.md"
    show(f"  {command} diagnose and {command} apply: the same with a recording of your own ({tutorial})")


def _show_demo(u: DemoUnit) -> None:
    extra = []
    if u.after_power_cycle:
        after = u.after_power_cycle
        extra.append(["the same after a power cycle", "", micro(after.rms_g), micro(after.noise_floor_g)])
    show_outcome(u.outcome, extra)
    for name, values in u.hidden.items():
        truth = ", ".join(f"{axis} {value:+.4g}" for axis, value in values.items())
        show(f"  hidden in it: {name} ({truth}): {'found' if u.found else 'NOT found'}")
    show(f"  after a power cycle: {'still within limits' if u.kept else 'NOT within limits'}")
    show("")


def sim_command(a: argparse.Namespace) -> int:
    from triaxcald.simulation.tray import load_tray

    source: Source | ServiceEvents | None = None
    if a.follow is not None:
        from triaxcald.simulation.follow import ServiceEvents, Source

        of_service = a.follow.startswith(("http://", "https://"))
        source = ServiceEvents(a.follow) if of_service else Source(a.follow)
    tray = load_tray(a.devices, followed=source is not None)
    try:
        run_interruptible(simulated(tray, source))
    except Interrupted as e:
        if e.number == signal.SIGINT:
            raise
        say("triaxcal: stopped")
    return 0


async def simulated(tray: Tray, source: Source | ServiceEvents | None) -> None:
    """Serve the units of a tray on their buses until cancelled."""
    from triaxcald.simulation.follow import follow
    from triaxcald.simulation.unit import keep_eeprom
    from triaxcald.station.simulators import Simulator, announced

    async with AsyncExitStack() as stack:
        simulators, lines = [], []
        for described, simulated in zip(tray.described, tray.units, strict=True):
            server = await stack.enter_async_context(simulated.serve())
            await stack.enter_async_context(keep_eeprom(simulated.unit, described.eeprom))
            device, reached = described.device, getattr(server, "bus", simulated.bus)
            serial = f"{device.serial:04d}"
            simulators.append(Simulator.of(described.path, serial, reached))
            bus = {**device.bus, **({"port": reached.port} if "port" in device.bus else {})}
            settings = ", ".join(f"{k}={v}" for k, v in bus.items())
            lines.append(f"serving {simulated.bundle.profile.name}, serial {serial}, on {settings}; Ctrl-C stops it")
        stack.enter_context(announced(simulators))
        for line in lines:
            say(line)
        if tray.operator is None or source is None:
            await asyncio.Event().wait()
            return
        units = {d.slot: u.unit for d, u in zip(tray.described, tray.units, strict=True)}
        await follow(source, tray.operator, units, tray.time_base, say)
