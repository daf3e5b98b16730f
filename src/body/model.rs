//! The body model: asset, shape, forward kinematics and linear blend skinning.

/// A loaded body asset.
pub struct BodyModel;
/// A body of one shape.
pub struct ShapedBody;
/// Joint rotations and positions of one frame.
pub struct Posed;
