"""Photographs of scenes with shiny objects in, scenes that can be seen from anywhere out."""

__version__ = "0.1.0"
