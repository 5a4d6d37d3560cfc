# Prefect's base job template of a kubernetes pool -> ours: volume claims `photos` and `runs`, no root, nothing written
# to the image, and no variable: whoever starts a run can't change its command, image or environment.
# docs/operations.md has the command. For the pool of a GPU's worker add, behind securityContext below:
#   resources: {limits: {"nvidia.com/gpu": 1}}
.variables = {type: "object", properties: {}, additionalProperties: false}
| .job_configuration |= (
  .namespace = "neuface"
  | .stream_output = true
  | .env = {DO_NOT_TRACK: "1", PREFECT_HOME: "/tmp/prefect", NEUFACE_ROOTS: "/photos:/runs"}
  | .job_manifest.metadata.namespace = "neuface"
  | .job_manifest.metadata.generateName = "neuface-"
  | .job_manifest.spec.ttlSecondsAfterFinished = 3600
)
| .job_configuration.job_manifest.spec.template.spec |= (
  . + {
    securityContext: {runAsNonRoot: true, runAsUser: 10001, runAsGroup: 10001, fsGroup: 10001},
    volumes: [
      {name: "photos", persistentVolumeClaim: {claimName: "photos", readOnly: true}},
      {name: "runs", persistentVolumeClaim: {claimName: "runs"}},
      {name: "tmp", emptyDir: {}}
    ]
  }
  | .containers[0] += {
    image: "neuface:cpu",
    imagePullPolicy: "IfNotPresent",
    securityContext: {readOnlyRootFilesystem: true, allowPrivilegeEscalation: false, capabilities: {drop: ["ALL"]}},
    volumeMounts: [
      {name: "photos", mountPath: "/photos", readOnly: true},
      {name: "runs", mountPath: "/runs"},
      {name: "tmp", mountPath: "/tmp"}
    ]
  }
)
# What is still a placeholder would take its value from the run.
| .job_configuration |= walk(
  if type == "object" then with_entries(select(.value | (type == "string" and test("\\{\\{")) | not)) else . end
)
