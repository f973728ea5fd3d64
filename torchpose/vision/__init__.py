"""From images to a cloud of points on the person: camera, disparity, silhouette, faces, points."""
