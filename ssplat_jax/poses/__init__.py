"""Camera poses from a video or from photos, by structure from motion (`pycolmap`, extra `poses`).

video -> frame_choice (sharp frames at equal motion) --+
folder -> photos (upright copies) ---------------------+-> images/ -> sfm (features, matching, mapping, refinement)
                                                                     pairs (which images to match)
sfm -> capture_files (transforms.json, sparse/) and verdict (plain words); estimate runs it all and resumes
"""
