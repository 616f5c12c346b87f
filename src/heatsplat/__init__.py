"""heatsplat: thermal-infrared scenes as 3D Gaussians whose appearance is a physical model of heat."""

__version__ = "0.1.0"
