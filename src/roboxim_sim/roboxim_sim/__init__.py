"""The simulated world: PyBullet, cameras, controllers, and the sim node."""
