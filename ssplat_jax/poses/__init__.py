"""Camera poses from a video or from photos, by structure from motion (`pycolmap`, extra `poses`).

video -> frame_choice (sharp frames at equal motion) --+
folder -> photos (upright copies) ---------------------+-> images/ -> sfm (features, matching, mapping, refinement)
                                                                     pairs (which images to match)
sfm -> capture_files (transforms.json, sparse/) and verdict (plain words); estimate runs it all and resumes

Poses that exist and are a little off need no `pycolmap`: adjust_poses moves them to fit the images.

frames, given poses -> tracks (matched keypoints) -> bundle_adjustment -> the capture with adjusted poses
"""
