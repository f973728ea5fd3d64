"""Registration of the body to a point cloud by variational expectation maximisation."""
