"""Losses as TorchRL modules: QR-SAC, RAC, Cat-RAC and categorical SAC. For plain SAC, use TorchRL's `SACLoss`."""

from coachable.losses.cat_rac import CatRACLoss
from coachable.losses.qr_sac import QRSACLoss
from coachable.losses.rac import RACLoss
from coachable.losses.sac_categorical import CategoricalSACLoss

__all__ = ["CatRACLoss", "CategoricalSACLoss", "QRSACLoss", "RACLoss"]
