"""The 256 pairs of points that ORB compares, learned by Rublee et al. for little correlation.

Pair k is (x, y) of a point and (x, y) of another, pixels from the keypoint before rotation; bit k
of the descriptor is set where the first is darker than the second. The table was measured: random
patches were described by OpenCV's ORB at angle 0, and for each bit the pair of pixels was looked
for that predicts it. Vocabularies trained on OpenCV's descriptors therefore serve these as well.

Reference: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV
2011, section 4.3.
"""

import numpy as np

__all__ = ["PAIRS", "REACH_PX"]

_BYTES = bytes.fromhex(
    """
    08fd0905 040207f4 f509f802 07f40cf3 02f3020c 01f90106 fef6fefc f3f3f5f8
    f3fdf4f7 0a040b09 f3f8f8f7 f507f70c 07070c06 fcfbfd00 f302f4fd f700f905
    0cfa0cff fd06fe0c faf3fcf8 0bf30cf8 04070501 05fd0afd 03f9060c f8f9fafe
    fe0bfff6 f30cf80a f903fbfd fc02fd07 f6f4fa0b 05f406f9 05fa07ff 010004fb
    090b0bf3 0407040c 02ff0404 fcf4fe07 f8fbf9f6 040b090c 00f801f3 f3fef802
    fdfefe03 fa09fcf7 080c0a07 00090103 07fb0bf6 f3faf500 0a070c01 fafdfa0c
    0af70cfc f308f8f4 f300f8fc 03030708 05070af9 ff0701f4 03f60506 02fc03f6
    f300f305 f3f9f40c f303f508 f90cfc07 06f60c08 f7fff9fa fefb000c f405f905
    03f608f3 f9f9fc05 fdfefff9 020905f5 f5f3fbf3 ff0600ff 05fd0502 fcf3fc0c
    f7faf706 f4f6f8fc 0a020cfd 070c0c0c f9f3fa05 fc09fd04 07ff0c02 f906fb01
    f30bf405 fd07fefa 07f80cf9 f3f9f5f4 01fd0c0c 02fa0300 fc03fef3 fff30109
    070108fa 01ff030c 09010c06 fff7ff03 f3f3f605 07070a0c 0cfb0c09 0603070b
    05f3060a 02f40203 030804fa 02060cf3 09f40a03 f804f909 f50cfcfa 010c02f8
    06f707fc 020303fe 06030b00 03fd08f8 07080903 f5fbfafc f60bfb0a fbf8fd0c
    f605f700 08ff0cfa 04fa06f5 f60cf807 04fe0607 fe00fe0c fbf8fb02 07fa0a0c
    f7f3f8f8 fbf3fbfe 08f809f3 f7f5f700 01f801fe 07fc0901 fe01fffc 0bfa0cf5
    f4f7fa04 0307070c 05050a08 00fc0208 f70cfbf3 0007020c ff020107 050b07f7
    030506f8 f3fcf809 fb09fdfd fcf9fdf4 06050800 f906fa0c f306fbfe 01f6030a
    040108fc fefe02f3 02f40c0c fef300fa 04010903 faf6fdfb fdf3ff01 07050cf5
    04fe05f9 f309f7fb 07010806 07f80706 f9fcf901 f80bf9f8 f306f4f8 02040309
    0afb0c03 fafbfa07 08fd09f8 02f40208 f5fef603 f4f3f9f7 f500f6fb 05fd0b08
    fef3ff0c fff80009 f3f5f4fb f6fef60b fd09fef3 02fd0302 f7f3fc00 fc06fdf6
    fc0cfef9 faf5fc09 06fd060b f30bfb05 0b0b0c06 07fb0cfe ff0c0007 fcf8fdfe
    f901fa07 f3f4f8f3 f9fefaf8 f805faf7 fbfffc05 f307f80a 010505f3 01000af3
    090c0aff 05f80af7 ff0b01f3 f7fdfa02 fff6010c f301f8f6 08f50afa 02f303fa
    07f30cf7 f6f6fbf9 f6f8f8f3 04fa0805 030c08f3 fc02fdfd 05f30af4 04f305ff
    f709fc03 000303f7 f401fa01 030204f8 f6f6f609 08f30c0c f8f4fafb 02020307
    0a060bf8 060808f4 f90afa05 fdf7fd09 fff3ff05 fdf9fd04 f8fef803 04020c0c
    02fb030b 06f70bf3 03ff070c 0bff0c04 fd00fd06 04f5040c 02fc0201 f6faf801
    f307f501 f30cf5f3 06000bf3 00ff0104 f303f7fe f708fafd f3faf8fe 05f7080a
    020703f7 fffaffff 09050bfe 0bfd0cf8 03000305 ff04000a 03fa0405 f300f605
    05080c0b 080909fa 07fc08f4 f604f609 07030c04 09f90afe 07000cfe fffa00f5
    """
)

PAIRS = np.frombuffer(_BYTES, np.int8).reshape(256, 4)
"""(256, 4) x, y of the first point and of the second; read-only."""

REACH_PX = 19
"""No point is farther than this from the keypoint, however turned."""
