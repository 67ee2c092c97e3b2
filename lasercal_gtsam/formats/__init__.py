"""Results in other programs' files, and intrinsics out of them.

`registry` lists the formats; `export.export` writes one; `intrinsics.load_intrinsics` reads. Every
module of a format has a writer and a reader that follow the format's own definition, each by
another way: what is written is read back and compared before it reaches the disk.

All the formats have the pixel convention of this package: (0, 0) is the centre of the top-left
pixel. OpenCV, and with it ROS and Kalibr, number pixels so, and mrcal documents the same; GTSAM
leaves it to the user. A format with (0, 0) at the corner (COLMAP's) would need half a pixel more.
"""
