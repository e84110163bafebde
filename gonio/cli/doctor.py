"""gonio doctor: what is wrong with the connections, and what mends it."""

from __future__ import annotations

from pathlib import Path

import click

from gonio.cli.output import json_option, speaking


@click.command()
@click.argument("rig_file", metavar="[RIG.TOML]", required=False, type=click.Path(path_type=Path, dir_okay=False))
@json_option
def doctor(rig_file: Path | None, as_json: bool) -> None:
    """Ports, adapters and cameras of this computer; with RIG.TOML its servos and lamp too. Nothing moves or is written.

    Exit code 3 if anything is wrong.
    """
    from gonio.config import load_rig
    from gonio.errors import DeviceError
    from gonio.rig.doctor import examine

    with speaking(as_json) as output:
        findings = []
        for finding in examine(None if rig_file is None else load_rig(rig_file), str(rig_file)):
            findings.append(finding)
            output.say(f"{'WRONG' if finding.mend else 'ok   '}  {finding.subject}: {finding.state}")
            if finding.mend:
                output.say(f"       mend it: {finding.mend}")
        wrong = [finding for finding in findings if finding.mend]
        output.result(findings=[vars(finding) for finding in findings], wrong=len(wrong))
        if wrong:
            output.finish()
            output.as_json = False  # printed already
            raise DeviceError(f"{len(wrong)} of {len(findings)} things looked at are wrong, the first: {wrong[0].subject}")
        output.say(f"all {len(findings)} things looked at are in order")
