"""EWA splatting of oriented disks."""

from catacaustics.splatting.reference import SplatOutput, splat_points

__all__ = ["SplatOutput", "splat_points"]
