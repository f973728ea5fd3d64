"""torchpose: markerless joint angles and activities of a person from a stereo or depth camera, as tensor programs."""
