"""What leaves a trained scene for other programs: its Gaussians as rendered, and their temperature over time as a basis."""
