"""Time-of-flight sensors on an I2C bus of the robot's computer: ``ranges = "vl53l1x:///dev/i2c-1?sensor=..."``.

As a lidar they are no driver: ``OneRobot`` adds their scans to what the robot's driver reads, and counts as in FAULT
while one of them measures nothing.

``settings.py``  what a URL says: bus, multiplexer, sensors, where on the robot each of them is
``protocol.py``  registers of the VL53L1X: what is written to it, what its results mean
``bus.py``       transfers on an I2C bus: of the kernel, or over a link (the emulator)
``sensor.py``    all sensors of a robot: a thread that reads them, starts them again, and keeps the newest scans
"""
