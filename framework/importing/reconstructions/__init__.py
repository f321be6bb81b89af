"""Import of RGB-D images with the poses of a reconstruction program."""
