"""What a camera and a white reference need before counts mean anything: darks, gain, linearity, reference reading.

Pure functions on arrays and frames. It opens no camera and no file, and it never guesses a missing calibration.
"""

from __future__ import annotations

from gonio.calibration.dark import Dark, crop, stack_dark, stack_darks
from gonio.calibration.linearity import Linearity, linearity
from gonio.calibration.photon_transfer import CameraNoise, PhotonTransfer, photon_transfer
from gonio.calibration.white import Reference, WhiteBlock, white_block

__all__ = [
    "CameraNoise",
    "Dark",
    "Linearity",
    "PhotonTransfer",
    "Reference",
    "WhiteBlock",
    "crop",
    "linearity",
    "photon_transfer",
    "stack_dark",
    "stack_darks",
    "white_block",
]
