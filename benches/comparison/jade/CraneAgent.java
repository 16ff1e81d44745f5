import jade.core.AID;
import jade.core.Agent;
import jade.core.behaviours.OneShotBehaviour;
import jade.domain.DFService;
import jade.domain.FIPAAgentManagement.DFAgentDescription;
import jade.domain.FIPAAgentManagement.ServiceDescription;
import jade.domain.FIPAException;
import jade.domain.FIPANames;
import jade.lang.acl.ACLMessage;
import jade.proto.AchieveREInitiator;
import jade.proto.AchieveREResponder;

/**
 * A crane of a JADE platform that works with agents behind a gateway: name and address of the gateway.
 *
 * It offers its service at the gateway's directory facilitator, requests the first arm that it finds there, and
 * answers requests itself.
 */
public class CraneAgent extends Agent {
    // ANCHOR: crane
    private AID there(String name, String address) {
        // ISGUID: the name is used as it is, without the name of this platform.
        AID id = new AID(name, AID.ISGUID);
        id.addAddresses(address);
        return id;
    }

    private static DFAgentDescription offering(String type, String name) {
        ServiceDescription service = new ServiceDescription();
        service.setType(type);
        service.setName(name);
        DFAgentDescription description = new DFAgentDescription();
        description.addServices(service);
        return description;
    }

    private void request(AID arm) {
        ACLMessage lift = new ACLMessage(ACLMessage.REQUEST);
        lift.setProtocol(FIPANames.InteractionProtocol.FIPA_REQUEST);
        lift.addReceiver(arm);
        lift.setContent("crate");
        addBehaviour(new AchieveREInitiator(this, lift) {
            @Override
            protected void handleInform(ACLMessage done) {
                System.out.println("CRANE result " + done.getContent());
            }

            @Override
            protected void handleFailure(ACLMessage failure) {
                System.out.println("CRANE failure " + failure.getContent());
            }
        });
    }

    private void serve() {
        addBehaviour(new AchieveREResponder(this,
                AchieveREResponder.createMessageTemplate(FIPANames.InteractionProtocol.FIPA_REQUEST)) {
            @Override
            protected ACLMessage handleRequest(ACLMessage request) {
                ACLMessage agree = request.createReply();
                agree.setPerformative(ACLMessage.AGREE);
                return agree;
            }

            @Override
            protected ACLMessage prepareResultNotification(ACLMessage request, ACLMessage agree) {
                ACLMessage done = request.createReply();
                done.setPerformative(ACLMessage.INFORM);
                done.setContent("moved " + request.getContent());
                return done;
            }
        });
    }
    // ANCHOR_END: crane

    @Override
    protected void setup() {
        final String gateway = (String) getArguments()[0];
        final String address = (String) getArguments()[1];
        serve();
        addBehaviour(new OneShotBehaviour(this) {
            @Override
            public void action() {
                // ANCHOR: df
                AID df = there("df@" + gateway, address);
                try {
                    DFAgentDescription own = offering("moving", "crane");
                    own.setName(getAID());
                    DFService.register(myAgent, df, own);
                    DFAgentDescription sought = offering("lifting", null);
                    DFAgentDescription[] found = DFService.search(myAgent, df, sought);
                    for (DFAgentDescription one : found) {
                        AID arm = there(one.getName().getName(), address);
                        request(arm);
                    }
                } catch (FIPAException refused) {
                    System.out.println("CRANE refused " + refused.getMessage());
                }
                // ANCHOR_END: df
                System.out.println("CRANE ready");
            }
        });
    }
}
