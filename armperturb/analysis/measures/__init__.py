"""What trials measure: pulses, variance accounted for, kinematics, statistics."""
