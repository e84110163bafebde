"""The tables of a data set: one for each channel, on the same nodes, all with a grain or all without.

It decides from the samples whether there is a grain, and knows the file; how a table is made and evaluated is in
`gonio.brdf.tabulated`, `gonio.brdf.grained`, `gonio.brdf.scattered` and `gonio.brdf.regression`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gonio.brdf import grained, tabulated
from gonio.brdf.base import BRDF
from gonio.brdf.grained import GrainedTable
from gonio.brdf.tabulated import TabulatedBRDF
from gonio.channels import SINGLE, Channels, ChannelSamples
from gonio.errors import ConfigurationError, DatasetError
from gonio.samples import BRDFSamples

Table = TabulatedBRDF | GrainedTable


@dataclass(frozen=True)
class Tables:
    """A table for each channel.

    Attributes
    ----------
    tables : tuple of TabulatedBRDF or of GrainedTable
        Of one shape and scale.
    channels : Channels, optional
    """

    tables: tuple[Table, ...]
    channels: Channels = SINGLE

    def __post_init__(self) -> None:
        if len(self.tables) != len(self.channels):
            raise DatasetError(f"{len(self.channels)} channels need as many tables, got {len(self.tables)}")
        if len({(table.shape, table.scale) for table in self.tables}) != 1:
            raise DatasetError("the tables of the channels have different nodes; make them together")

    @classmethod
    def of(cls, table: Tables | Table) -> Tables:
        """Itself, or a table alone."""
        return table if isinstance(table, Tables) else cls((table,))

    @property
    def main(self) -> Table:
        """The channel for whoever wants one: Y, green, or the wavelength nearest to 555 nm."""
        return self.tables[self.channels.main]

    @property
    def grained(self) -> bool:
        """Whether the azimuth of the half vector is a coordinate."""
        return isinstance(self.main, GrainedTable)

    @property
    def attributes(self) -> Mapping[str, str]:
        """Of the main channel's table."""
        return self.main.attributes

    def one(self, channel: str) -> Tables:
        """A channel alone, or a `ConfigurationError` that lists them."""
        k = self.channels.index(channel)
        waves = self.channels.wavelengths_nm
        return Tables((self.tables[k],), Channels((channel,), None if waves is None else (waves[k],)))

    def brdf(self) -> BRDF:
        """The main channel's table as a BRDF."""
        return self.main.brdf()

    def counts(self) -> dict[str, int]:
        """Number of nodes of the main channel by coverage."""
        return self.main.counts()

    def samples(self) -> ChannelSamples:
        """The nodes that were measured or interpolated in the main channel, as samples in all channels."""
        parts = [replace(table, coverage=self.main.coverage).samples() for table in self.tables]
        value, u = (np.stack([getattr(p, name) for p in parts], axis=-1) for name in ("f_r", "u_f_r"))
        one = parts[0]
        at = one.theta_i, one.phi_i, one.theta_r, one.phi_r
        return ChannelSamples.make(*at, value, self.channels, u, self.attributes)

    def save(self, path: str | Path) -> None:
        """Write the tables as NetCDF."""
        from gonio.formats import netcdf

        netcdf.write(Path(path), table=self)

    @classmethod
    def load(cls, path: str | Path) -> Tables:
        """Read tables from NetCDF; `DatasetError` if the file holds none."""
        from gonio.formats import netcdf

        return netcdf.read_tables(Path(path))


def tabulate(
    samples: BRDFSamples | ChannelSamples,
    *,
    fill: BRDF | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Tables:
    """Tables of scattered samples, with a grain if they show one.

    Parameters
    ----------
    samples : BRDFSamples or ChannelSamples
        Each channel at least 12, with a grain 60.
    fill : BRDF, optional
        As of `gonio.brdf.tabulated.tabulate`; of one channel only.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    ConfigurationError
        If a fill is given for several channels.
    DatasetError
        If a channel has too few samples, or no positive one.
    """
    sets = samples.all_channels() if isinstance(samples, ChannelSamples) else (samples,)
    channels = samples.channels if isinstance(samples, ChannelSamples) else SINGLE
    if fill is not None and len(sets) > 1:
        raise ConfigurationError(f"a fit of one channel cannot fill a table of {len(sets)}; choose one channel")
    main = sets[channels.main]
    make = grained.tabulate if grained.shown_by(main) else tabulated.tabulate
    made: dict[int, Table] = {}
    scale = None
    for count, k in enumerate([channels.main, *(k for k in range(len(sets)) if k != channels.main)]):

        def tell(done: int, total: int, count: int = count) -> None:
            if progress is not None:
                progress(count * total + done, len(sets) * total)

        try:
            made[k] = make(sets[k], fill=fill, scale=scale, progress=tell)
        except DatasetError as error:
            raise DatasetError(f"channel {channels.names[k]}: {error}" if len(sets) > 1 else str(error)) from None
        scale = made[channels.main].scale
    common = dict(made[channels.main].attributes)
    if len(sets) > 1:
        for key in ("channel", "wavelength_nm"):
            common.pop(key, None)
    return Tables(tuple(replace(made[k], attributes=common) for k in range(len(sets))), channels)
