"""EWA splatting of oriented disks."""

from catacaustics.splatting.reference import SplatOutput, points_in_view, splat_points

__all__ = ["SplatOutput", "points_in_view", "splat_points"]
