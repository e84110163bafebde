"""The simulated rig: servos, lamp and camera that answer as the real ones do, byte for byte and photon for photon."""
