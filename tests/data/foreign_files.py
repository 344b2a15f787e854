"""Parameter files of LIO-SAM and FAST-LIO2 with the values their systems come with."""

from textwrap import dedent, indent

LIO_SAM_ROS1 = """
lio_sam:
  pointCloudTopic: "points_raw"   # Topics
  imuTopic: "imu_raw"
  odomTopic: "odometry/imu"
  gpsTopic: "odometry/gps"
  lidarFrame: "base_link"
  baselinkFrame: "base_link"
  odometryFrame: "odom"
  mapFrame: "map"
  useImuHeadingInitialization: true
  useGpsElevation: false
  gpsCovThreshold: 2.0
  poseCovThreshold: 25.0
  savePCD: false
  savePCDDirectory: "/Downloads/LOAM/"
  sensor: velodyne
  N_SCAN: 16
  Horizon_SCAN: 1800
  downsampleRate: 1
  lidarMinRange: 1.0
  lidarMaxRange: 1000.0
  imuAccNoise: 3.9939570888238808e-03
  imuGyrNoise: 1.5636343949698187e-03
  imuAccBiasN: 6.4356659353532566e-05
  imuGyrBiasN: 3.5640318696367613e-05
  imuGravity: 9.80511
  imuRPYWeight: 0.01
  extrinsicTrans: [0.0, 0.0, 0.0]
  extrinsicRot: [-1, 0, 0,
                  0, 1, 0,
                  0, 0, -1]
  extrinsicRPY: [0,  1, 0,
                 -1, 0, 0,
                  0, 0, 1]
  edgeThreshold: 1.0
  surfThreshold: 0.1
  edgeFeatureMinValidNum: 10
  surfFeatureMinValidNum: 100
  odometrySurfLeafSize: 0.4
  mappingCornerLeafSize: 0.2
  mappingSurfLeafSize: 0.4
  z_tollerance: 1000
  rotation_tollerance: 1000
  numberOfCores: 4
  mappingProcessInterval: 0.15
  surroundingkeyframeAddingDistThreshold: 1.0
  surroundingkeyframeAddingAngleThreshold: 0.2
  surroundingKeyframeDensity: 2.0
  surroundingKeyframeSearchRadius: 50.0
  loopClosureEnableFlag: true
  loopClosureFrequency: 1.0
  surroundingKeyframeSize: 50
  historyKeyframeSearchRadius: 15.0
  historyKeyframeSearchTimeDiff: 30.0
  historyKeyframeSearchNum: 25
  historyKeyframeFitnessScore: 0.3
  globalMapVisualizationSearchRadius: 1000.0
  globalMapVisualizationPoseDensity: 10.0
  globalMapVisualizationLeafSize: 1.0

# robot_localization's part of the file
navsat:
  frequency: 50
ekf_gps:
  publish_tf: false
"""

LIO_SAM_ROS2 = "/**:\n  ros__parameters:\n" + indent(
    dedent(LIO_SAM_ROS1.partition("lio_sam:\n")[2].partition("# robot_localization")[0]), "    "
)

FAST_LIO2_ROS1 = """
common:
    lid_topic:  "/livox/lidar"
    imu_topic:  "/livox/imu"
    time_sync_en: false
    time_offset_lidar_to_imu: 0.02

preprocess:
    lidar_type: 1
    scan_line: 6
    blind: 4
    timestamp_unit: 3
    scan_rate: 20

mapping:
    acc_cov: 0.1
    gyr_cov: 0.1
    b_acc_cov: 0.0001
    b_gyr_cov: 0.0001
    fov_degree:    90
    det_range:     450.0
    extrinsic_est_en:  false
    extrinsic_T: [ 0.04165, 0.02326, -0.0284 ]
    extrinsic_R: [ 1, 0, 0,
                   0, 1, 0,
                   0, 0, 1]

publish:
    path_en:  false
    scan_publish_en:  true

pcd_save:
    pcd_save_en: true
    interval: -1
"""

FAST_LIO2_ROS2 = """
/**:
  ros__parameters:
    feature_extract_enable: false
    point_filter_num: 3
    max_iteration: 3
    filter_size_surf: 0.5
    filter_size_map: 0.5
    cube_side_length: 1000.0
    runtime_pos_log_enable: false
    map_file_path: "./test.pcd"
    common: {lid_topic: "/os_cloud_node/points", imu_topic: "/os_cloud_node/imu"}
    preprocess: {lidar_type: 3, scan_line: 64, blind: 4.0, timestamp_unit: 3, scan_rate: 10}
    mapping.acc_cov: 0.1
    mapping:
      gyr_cov: 0.1
      b_acc_cov: 0.0001
      b_gyr_cov: 0.0001
      fov_degree: 180.0
      det_range: 150.0
      extrinsic_est_en: true
      extrinsic_T: [0.0, 0.0, 0.0]
      extrinsic_R: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
"""
