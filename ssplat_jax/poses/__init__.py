"""Camera poses: estimated by COLMAP (`pycolmap`, extra `poses`) from a video or photos, or adjusted near given ones.

video | folder of photos -> gather_images -> sfm -> estimate: a capture, resumed where it stopped
frames, given poses -> bundle_adjustment (tracks first) -> adjust_poses: the capture with poses that fit its images
"""
