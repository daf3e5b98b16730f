//! Rotations: axis-angle and the continuous 6-D form.
